//! Spherical harmonics: the Python face of `bigs_raster::Harmonics`.

use bigs_raster::{Harmonics, Scalar};
use numpy::{Element, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::convert::{self, contiguous, gradient, is_single, rows, slice};
use crate::run;

/// The arrays of a call, borrowed for as long as this lives.
struct Arrays<'py, T: Element> {
    dirs: PyReadonlyArrayDyn<'py, T>,
    coefficients: PyReadonlyArrayDyn<'py, T>,
    mask: Option<Vec<bool>>,
}

impl<'py, T: Scalar + Element> Arrays<'py, T> {
    /// Reads (dirs, coefficients, mask | None).
    fn extract(arrays: &Bound<'py, PyTuple>) -> PyResult<Self> {
        if arrays.len() != 3 {
            return Err(PyTypeError::new_err("arrays: expected three entries"));
        }
        let mask = arrays.get_item(2)?;
        Ok(Self {
            dirs: slice("dirs", &arrays.get_item(0)?)?,
            coefficients: slice("coeffs", &arrays.get_item(1)?)?,
            mask: (!mask.is_none())
                .then(|| convert::mask("masks", &mask))
                .transpose()?,
        })
    }

    fn harmonics(&self, degree: usize) -> PyResult<Harmonics<'_, T>> {
        let shape = self.coefficients.shape();
        if shape.len() < 2 || shape[shape.len() - 1] != 3 {
            return Err(PyValueError::new_err(format!(
                "coeffs: expected axes for bases and three colours, found shape {shape:?}"
            )));
        }
        let dirs = rows("dirs", &self.dirs)?;
        Harmonics::new(
            degree,
            shape[shape.len() - 2],
            dirs,
            contiguous("coeffs", &self.coefficients)?,
            self.mask.as_deref(),
        )
        .map_err(crate::value_error)
    }
}

fn forward<'py, T: Scalar + Element>(
    py: Python<'py>,
    degree: usize,
    arrays: &Arrays<'py, T>,
) -> PyResult<Bound<'py, PyAny>> {
    let harmonics = arrays.harmonics(degree)?;
    let colors = run(py, || Ok(harmonics.evaluate()))?;
    Ok(gradient(py, colors.into_flattened()).into_any())
}

/// Colours of the directions, flat. `arrays` is (dirs `[.., N, 3]`, coeffs `[N, K, 3]`, mask `[.., N]` or None),
/// C-contiguous, float32 or float64 throughout; all Gaussians of one place, then all of the next. Raises ValueError.
#[pyfunction]
pub(crate) fn harmonics_forward<'py>(
    py: Python<'py>,
    degree: usize,
    arrays: &Bound<'py, PyTuple>,
) -> PyResult<Bound<'py, PyAny>> {
    if is_single(arrays) {
        forward(py, degree, &Arrays::<f32>::extract(arrays)?)
    } else {
        forward(py, degree, &Arrays::<f64>::extract(arrays)?)
    }
}

fn backward<'py, T: Scalar + Element>(
    py: Python<'py>,
    degree: usize,
    arrays: &Arrays<'py, T>,
    v_colors: &Bound<'py, PyAny>,
    [dirs, coefficients]: [bool; 2],
) -> PyResult<Bound<'py, PyTuple>> {
    let harmonics = arrays.harmonics(degree)?;
    let v_colors = slice::<T>("v_colors", v_colors)?;
    let v_colors = rows("v_colors", &v_colors)?;
    let gradients = run(py, || harmonics.vjp(v_colors, dirs, coefficients))?;
    (
        gradient(py, gradients.dirs.into_flattened()),
        gradient(py, gradients.coefficients),
    )
        .into_pyobject(py)
}

/// Gradients of dirs and coeffs, flat; what is not wanted is an empty array. Takes the arrays of the forward call.
#[pyfunction]
pub(crate) fn harmonics_backward<'py>(
    py: Python<'py>,
    degree: usize,
    arrays: &Bound<'py, PyTuple>,
    v_colors: &Bound<'py, PyAny>,
    wanted: [bool; 2],
) -> PyResult<Bound<'py, PyTuple>> {
    if is_single(arrays) {
        backward(py, degree, &Arrays::<f32>::extract(arrays)?, v_colors, wanted)
    } else {
        backward(py, degree, &Arrays::<f64>::extract(arrays)?, v_colors, wanted)
    }
}

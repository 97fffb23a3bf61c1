//! The only place that touches numpy arrays: borrowed views in, owned vectors out, neither copied.

use bigs_raster::{BatchInputs, BatchShape, CameraModel, Real, Slabs};
use numpy::{
    Element, IntoPyArray, PyArray, PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// A borrowed array of this scalar; `TypeError` for another dtype.
pub(crate) fn slice<'py, T: Element>(
    name: &str,
    array: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArrayDyn<'py, T>> {
    let array = array
        .cast::<PyArrayDyn<T>>()
        .map_err(|_| PyTypeError::new_err(format!("{name}: expected one floating dtype for all arrays")))?;
    Ok(array.readonly())
}

/// The arrays of a call, borrowed for as long as this lives.
pub(crate) struct Arrays<'py, T: Element> {
    floats: Vec<PyReadonlyArrayDyn<'py, T>>,
    backgrounds: Option<PyReadonlyArrayDyn<'py, T>>,
    pixel_mask: Option<PyReadonlyArrayDyn<'py, bool>>,
}

const NAMES: [&str; 7] = [
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "viewmats",
    "Ks",
];

impl<'py, T: Real + Element> Arrays<'py, T> {
    /// Reads (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds | None, pixel_mask | None).
    pub(crate) fn extract(arrays: &Bound<'py, PyTuple>) -> PyResult<Self> {
        if arrays.len() != NAMES.len() + 2 {
            return Err(PyTypeError::new_err("arrays: expected nine entries"));
        }
        let optional = |index: usize| {
            arrays
                .get_item(index)
                .map(|item| (!item.is_none()).then_some(item))
        };
        Ok(Self {
            floats: NAMES
                .iter()
                .enumerate()
                .map(|(index, name)| slice(name, &arrays.get_item(index)?))
                .collect::<PyResult<_>>()?,
            backgrounds: optional(7)?.map(|item| slice("backgrounds", &item)).transpose()?,
            pixel_mask: optional(8)?.map(|item| slice("pixel_mask", &item)).transpose()?,
        })
    }

    /// The same as borrowed slabs, and the sizes they imply.
    pub(crate) fn inputs(
        &self,
        (width, height): (usize, usize),
        camera_model: CameraModel,
    ) -> PyResult<(BatchShape, BatchInputs<'_, T>)> {
        let slabs = |index: usize| slabs(NAMES[index], &self.floats[index]);
        let inputs = BatchInputs {
            means: slabs(0)?,
            quats: slabs(1)?,
            scales: slabs(2)?,
            opacities: slabs(3)?,
            colors: slabs(4)?,
            viewmats: slabs(5)?,
            ks: slabs(6)?,
            camera_model,
            backgrounds: self
                .backgrounds
                .as_ref()
                .map(|a| self::slabs("backgrounds", a))
                .transpose()?,
            pixel_mask: self
                .pixel_mask
                .as_ref()
                .map(|a| self::slabs("pixel_mask", a))
                .transpose()?,
        };
        let floats = [
            inputs.means,
            inputs.quats,
            inputs.scales,
            inputs.opacities,
            inputs.colors,
            inputs.viewmats,
            inputs.ks,
        ];
        let optional = [
            inputs.backgrounds.map(|s| (s.entries, s.cameras)),
            inputs.pixel_mask.map(|s| (s.entries, s.cameras)),
        ];
        let sizes = floats
            .iter()
            .map(|s| (s.entries, s.cameras))
            .chain(optional.into_iter().flatten());
        let (entries, cameras) = sizes.fold((1, 1), |a, b| (wider(a.0, b.0), wider(a.1, b.1)));
        let last = |index: usize, from_end: usize| {
            let shape = self.floats[index].shape();
            shape[shape.len() - from_end]
        };
        let shape = BatchShape {
            entries,
            cameras,
            gaussians: last(0, 2),
            channels: last(4, 1),
            width,
            height,
        };
        Ok((shape, inputs))
    }
}

/// The size two broadcast sizes have together; a size of 0 stays 0.
fn wider(a: usize, b: usize) -> usize {
    if a == 1 { b } else { a }
}

fn slabs<'a, U: Element>(name: &str, array: &'a PyReadonlyArrayDyn<'_, U>) -> PyResult<Slabs<'a, U>> {
    let shape = array.shape();
    if shape.len() < 3 {
        return Err(PyValueError::new_err(format!(
            "{name}: expected axes for entries and cameras, found shape {shape:?}"
        )));
    }
    let data = array
        .as_slice()
        .map_err(|_| PyValueError::new_err(format!("{name}: expected a C-contiguous array")))?;
    Ok(Slabs {
        data,
        entries: shape[0],
        cameras: shape[1],
    })
}

/// Shape of an output.
pub(crate) type Shape<const N: usize> = [usize; N];

/// Hands a vector over to numpy.
pub(crate) fn array<'py, U: Element, const N: usize>(
    py: Python<'py>,
    values: Vec<U>,
    shape: Shape<N>,
) -> PyResult<Bound<'py, PyAny>>
where
    [usize; N]: numpy::ndarray::IntoDimension,
{
    let flat: Bound<'py, PyArray<U, _>> = values.into_pyarray(py);
    Ok(flat.reshape(shape)?.into_any())
}

/// Hands a flat gradient over to numpy.
pub(crate) fn gradient<U: Element>(py: Python<'_>, values: Vec<U>) -> Bound<'_, PyArray1<U>> {
    values.into_pyarray(py)
}

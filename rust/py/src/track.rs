//! Patches: the Python face of `bigs_track`.

use bigs_track::{Laying, Picture, Templates, TrackError};
use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::call;
use crate::convert::{contiguous, gradient, rows, slice};

/// A picture's planes, borrowed for as long as this lives.
struct Planes<'py>(PyReadonlyArrayDyn<'py, f32>);

impl<'py> Planes<'py> {
    /// Reads an array [2, H, W]: grey, and the share of what is tracked.
    fn extract(picture: &Bound<'py, PyAny>) -> PyResult<Self> {
        let planes = slice("picture", picture)?;
        if planes.shape().len() != 3 || planes.shape()[0] != 2 {
            return Err(PyValueError::new_err(format!(
                "picture: expected the shape (2, H, W), found {:?}",
                planes.shape()
            )));
        }
        Ok(Self(planes))
    }

    fn picture(&self) -> PyResult<Picture<'_>> {
        let (height, width) = (self.0.shape()[1], self.0.shape()[2]);
        let (grey, shown) = contiguous("picture", &self.0)?.split_at(height * width);
        Picture::new(grey, shown, width, height).map_err(refused)
    }
}

pub(crate) fn refused(error: TrackError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

fn run<R: Send>(py: Python<'_>, work: impl FnOnce() -> Result<R, TrackError> + Send) -> PyResult<R> {
    call::run(py, "laying patches", refused, work)
}

/// Patches about `places` `[N, 2]` of a picture `[2, H, W]`, flat: grey, slopes, weights. Raises ValueError.
#[pyfunction]
pub(crate) fn cut_patches<'py>(
    py: Python<'py>,
    picture: &Bound<'py, PyAny>,
    places: &Bound<'py, PyAny>,
    half: usize,
) -> PyResult<Bound<'py, PyTuple>> {
    let planes = Planes::extract(picture)?;
    let places = slice("places", places)?;
    let (picture, places) = (planes.picture()?, rows("places", &places)?);
    let found = run(py, || bigs_track::cut(&picture, places, half))?;
    PyTuple::new(
        py,
        [found.grey, found.slope.into_flattened(), found.weight]
            .map(|values| gradient(py, values).into_any()),
    )
}

/// Where patches, cut from other pictures, come to lie in this one. Raises ValueError.
///
/// `templates` are grey `[N, S]`, slopes `[N, S, 2]` and weights `[N, S]`, which begin at `starts` `[N, 2]` and are
/// turned by `warps` `[N, 2, 2]`; `limits` are the least share shown, likeness, most moved, most unsure. Returns places
/// `[N * 2]`, their covariances `[N * 3]`, and which `[N]` fit.
#[pyfunction]
pub(crate) fn lay_patches<'py>(
    py: Python<'py>,
    picture: &Bound<'py, PyAny>,
    templates: [Bound<'py, PyAny>; 3],
    starts: &Bound<'py, PyAny>,
    warps: &Bound<'py, PyAny>,
    half: usize,
    iterations: usize,
    limits: [f32; 4],
) -> PyResult<Bound<'py, PyTuple>> {
    let planes = Planes::extract(picture)?;
    let [grey, slope, weight] = &templates;
    let (grey, slope, weight) = (
        slice("grey", grey)?,
        slice("slope", slope)?,
        slice("weight", weight)?,
    );
    let (starts, warps) = (slice("starts", starts)?, slice("warps", warps)?);
    let templates = Templates {
        grey: contiguous("grey", &grey)?,
        slope: rows("slope", &slope)?,
        weight: contiguous("weight", &weight)?,
    };
    let [least_shown, likeness, most_moved, most_unsure] = limits;
    let laying = Laying {
        half,
        iterations,
        least_shown,
        likeness,
        most_moved,
        most_unsure,
    };
    let (picture, starts) = (planes.picture()?, rows("starts", &starts)?);
    let warps: &[[f32; 2]] = rows("warps", &warps)?;
    let laid = run(py, || {
        bigs_track::lay(&picture, &templates, starts, warps.as_chunks().0, &laying)
    })?;
    PyTuple::new(
        py,
        [
            gradient(py, laid.places.into_flattened()).into_any(),
            gradient(py, laid.covariances.into_flattened()).into_any(),
            gradient(py, laid.fits).into_any(),
        ],
    )
}

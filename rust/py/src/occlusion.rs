//! Ambient occlusion: the Python face of `bigs_ops::occlusion`.

use bigs_ops::occlusion::{Discs, Places, form_factors as summed};
use numpy::PyUntypedArrayMethods;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::convert::{contiguous, gradient, is_single, rows};
use crate::poses::held;
use crate::{Kind, run};

const ARRAYS: [&str; 5] = ["points", "normals", "disc points", "disc normals", "areas"];

fn sums<'py, T: Kind>(py: Python<'py>, arrays: &Bound<'py, PyTuple>) -> PyResult<Bound<'py, PyAny>> {
    let [points, normals, disc_points, disc_normals, areas] = held::<T, 5>(ARRAYS, arrays)?;
    let frames = points.shape().first().copied().unwrap_or(0);
    let places = Places {
        points: rows(ARRAYS[0], &points)?,
        normals: rows(ARRAYS[1], &normals)?,
    };
    let discs = Discs {
        places: Places {
            points: rows(ARRAYS[2], &disc_points)?,
            normals: rows(ARRAYS[3], &disc_normals)?,
        },
        areas: contiguous(ARRAYS[4], &areas)?,
    };
    let found = run(py, || summed(frames, &places, &discs))?;
    Ok(gradient(py, found).into_any())
}

/// Flat sums of form factors at places in B frames; `arrays` is (points `[B, N, 3]`, normals `[B, N, 3]`, points and normals
/// of discs `[B, M, 3]`, their areas `[M]`), C-contiguous, float32 or float64 throughout. Raises ValueError.
#[pyfunction]
pub(crate) fn form_factors<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
) -> PyResult<Bound<'py, PyAny>> {
    if is_single(arrays) {
        sums::<f32>(py, arrays)
    } else {
        sums::<f64>(py, arrays)
    }
}

//! What a mesh covers: the Python face of `bigs_ops::outline`.

use bigs_ops::outline::{Covered, Mesh};
use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::convert::{contiguous, gradient, is_single, rows, slice};
use crate::poses::held;
use crate::{Kind, run};

/// What a mesh covers, for the backward pass. Opaque; usable any number of times.
#[pyclass(frozen, module = "bigs._raster")]
pub(crate) struct OutlineState {
    covered: Covered,
}

const ARRAYS: [&str; 2] = ["points", "intrinsics"];

/// Triangles, and the picture's width and height.
type Options<'py> = (Bound<'py, PyAny>, [usize; 2]);

fn triangles(faces: &Bound<'_, PyAny>) -> PyResult<Vec<[usize; 3]>> {
    let faces: PyReadonlyArrayDyn<'_, i64> = slice("faces", faces)?;
    let index = |&value: &i64| {
        usize::try_from(value)
            .map_err(|_| PyValueError::new_err(format!("faces: expected indices of vertices, found {value}")))
    };
    rows::<_, 3>("faces", &faces)?
        .iter()
        .map(|[a, b, c]| Ok([index(a)?, index(b)?, index(c)?]))
        .collect()
}

fn mesh<'a, T: Kind>(
    [points, intrinsics]: &'a [PyReadonlyArrayDyn<'_, T>; 2],
    faces: &'a [[usize; 3]],
    size: [usize; 2],
) -> PyResult<Mesh<'a, T>> {
    let &[u, v, _] = rows(ARRAYS[1], intrinsics)? else {
        return Err(PyValueError::new_err("intrinsics: expected three rows"));
    };
    Ok(Mesh {
        frames: points.shape().first().copied().unwrap_or(0),
        points: rows(ARRAYS[0], points)?,
        faces,
        intrinsics: [u, v],
        size,
    })
}

fn cover<'py, T: Kind>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    (faces, size): Options<'py>,
) -> PyResult<Bound<'py, PyTuple>> {
    let arrays = held::<T, 2>(ARRAYS, arrays)?;
    let faces = triangles(&faces)?;
    let mesh = mesh(&arrays, &faces, size)?;
    let (covered, shares) = run(py, || {
        let covered = mesh.cover()?;
        let shares = covered.shares::<T>()?;
        Ok((covered, shares))
    })?;
    (gradient(py, shares), OutlineState { covered }).into_pyobject(py)
}

/// Flat shares `[B, H, W]` of pixels that a mesh covers, and a state for the backward pass.
///
/// `arrays` is (points `[B, V, 3]`, intrinsics `[3, 3]`), C-contiguous, both float32 or float64; `options` is the triangles
/// `[F, 3]` (int64), and width and height of the picture. Raises ValueError.
#[pyfunction]
pub(crate) fn outline_forward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    options: Options<'py>,
) -> PyResult<Bound<'py, PyTuple>> {
    if is_single(arrays) {
        cover::<f32>(py, arrays, options)
    } else {
        cover::<f64>(py, arrays, options)
    }
}

fn back<'py, T: Kind>(
    py: Python<'py>,
    state: &Covered,
    arrays: &Bound<'py, PyTuple>,
    (faces, size): Options<'py>,
    v_shares: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    let arrays = held::<T, 2>(ARRAYS, arrays)?;
    let faces = triangles(&faces)?;
    let mesh = mesh(&arrays, &faces, size)?;
    let v_shares = slice::<T>("v_shares", v_shares)?;
    let v_shares = contiguous("v_shares", &v_shares)?;
    let found = run(py, || mesh.vjp(state, v_shares))?;
    Ok(gradient(py, found.into_flattened()).into_any())
}

/// The flat gradient of the points from that of the shares.
#[pyfunction]
pub(crate) fn outline_backward<'py>(
    py: Python<'py>,
    state: &Bound<'py, OutlineState>,
    arrays: &Bound<'py, PyTuple>,
    options: Options<'py>,
    v_shares: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    let covered = &state.get().covered;
    if is_single(arrays) {
        back::<f32>(py, covered, arrays, options, v_shares)
    } else {
        back::<f64>(py, covered, arrays, options, v_shares)
    }
}

//! Rotations and joint trees: the Python face of `bigs_ops::joints`.

use bigs_ops::joints::{Tree, rotations, rotations_vjp};
use numpy::{Element, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::Kind;
use crate::convert::{contiguous, gradient, is_single, rows, slice};
use crate::run;

/// N named arrays of a tuple, borrowed for as long as this lives.
pub(crate) fn held<'py, T: Element, const N: usize>(
    names: [&str; N],
    arrays: &Bound<'py, PyTuple>,
) -> PyResult<[PyReadonlyArrayDyn<'py, T>; N]> {
    let found = names
        .iter()
        .enumerate()
        .map(|(at, name)| slice(name, &arrays.get_item(at)?))
        .collect::<PyResult<Vec<_>>>()?;
    found
        .try_into()
        .map_err(|_| PyTypeError::new_err(format!("arrays: expected {}", names.join(", "))))
}

/// The values of an array in rows of D, whatever its last axes are.
pub(crate) fn records<'a, U: Element, const D: usize>(
    name: &str,
    array: &'a PyReadonlyArrayDyn<'_, U>,
) -> PyResult<&'a [[U; D]]> {
    match contiguous(name, array)?.as_chunks() {
        (records, []) => Ok(records),
        _ => Err(PyValueError::new_err(format!(
            "{name}: expected records of {D} values, found shape {:?}",
            array.shape()
        ))),
    }
}

fn turn<'py, T: Kind>(py: Python<'py>, arrays: &Bound<'py, PyTuple>) -> PyResult<Bound<'py, PyAny>> {
    let [vectors] = held::<T, 1>(["vectors"], arrays)?;
    Ok(gradient(py, rotations(rows("vectors", &vectors)?).into_flattened()).into_any())
}

/// Flat matrices of the rotation vectors `[.., 3]`, the only entry of `arrays`.
#[pyfunction]
pub(crate) fn rotations_forward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
) -> PyResult<Bound<'py, PyAny>> {
    if is_single(arrays) {
        turn::<f32>(py, arrays)
    } else {
        turn::<f64>(py, arrays)
    }
}

fn turn_back<'py, T: Kind>(py: Python<'py>, arrays: &Bound<'py, PyTuple>) -> PyResult<Bound<'py, PyAny>> {
    let [vectors, v] = held::<T, 2>(["vectors", "v_matrices"], arrays)?;
    let found = rotations_vjp(rows("vectors", &vectors)?, records("v_matrices", &v)?);
    Ok(gradient(py, found.map_err(crate::value_error)?.into_flattened()).into_any())
}

/// Flat gradients of the vectors `[.., 3]`; `arrays` is they and the gradients of the matrices `[.., 3, 3]`.
#[pyfunction]
pub(crate) fn rotations_backward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
) -> PyResult<Bound<'py, PyAny>> {
    if is_single(arrays) {
        turn_back::<f32>(py, arrays)
    } else {
        turn_back::<f64>(py, arrays)
    }
}

const TREE: [&str; 3] = ["rotations", "rest_joints", "root"];

fn pose_tree<'py, T: Kind>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    parents: &[usize],
) -> PyResult<Bound<'py, PyTuple>> {
    let [rotations, rest, root] = held::<T, 3>(TREE, arrays)?;
    let tree = Tree {
        parents,
        rotations: records("rotations", &rotations)?,
        rest: rows("rest_joints", &rest)?,
        root: rows("root", &root)?,
    };
    let posed = run(py, || tree.pose())?;
    (
        gradient(py, posed.joints.into_flattened()),
        gradient(py, posed.bones.into_flattened()),
    )
        .into_pyobject(py)
}

/// Flat joints `[B, K, 3]` and bones `[B, K, 4, 4]`; `arrays` is (rotations `[B, K, 3, 3]`, rest_joints `[K, 3]` or
/// `[B, K, 3]`, root `[B, 3]`). Raises ValueError.
#[pyfunction]
pub(crate) fn tree_forward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    parents: Vec<usize>,
) -> PyResult<Bound<'py, PyTuple>> {
    if is_single(arrays) {
        pose_tree::<f32>(py, arrays, &parents)
    } else {
        pose_tree::<f64>(py, arrays, &parents)
    }
}

fn pose_tree_back<'py, T: Kind>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    parents: &[usize],
    [v_joints, v_bones]: [Option<&Bound<'py, PyAny>>; 2],
) -> PyResult<Bound<'py, PyTuple>> {
    let [rotations, rest, root] = held::<T, 3>(TREE, arrays)?;
    let tree = Tree {
        parents,
        rotations: records("rotations", &rotations)?,
        rest: rows("rest_joints", &rest)?,
        root: rows("root", &root)?,
    };
    let v_joints = v_joints.map(|v| slice::<T>("v_joints", v)).transpose()?;
    let v_bones = v_bones.map(|v| slice::<T>("v_bones", v)).transpose()?;
    let v_joints = v_joints.as_ref().map(|v| rows("v_joints", v)).transpose()?;
    let v_bones = v_bones.as_ref().map(|v| records("v_bones", v)).transpose()?;
    let found = run(py, || tree.vjp(v_joints, v_bones))?;
    (
        gradient(py, found.rotations.into_flattened()),
        gradient(py, found.rest.into_flattened()),
        gradient(py, found.root.into_flattened()),
    )
        .into_pyobject(py)
}

/// Flat gradients of rotations, rest_joints and root from those of joints and bones, either of which may be None.
#[pyfunction]
pub(crate) fn tree_backward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    parents: Vec<usize>,
    pulls: [Option<Bound<'py, PyAny>>; 2],
) -> PyResult<Bound<'py, PyTuple>> {
    let pulls = [0, 1].map(|i| pulls[i].as_ref());
    if is_single(arrays) {
        pose_tree_back::<f32>(py, arrays, &parents, pulls)
    } else {
        pose_tree_back::<f64>(py, arrays, &parents, pulls)
    }
}

//! Distances from an object and what touches it: the Python face of `bigs_ops::distance` and `bigs_ops::touch`.

use bigs_ops::distance::Grid;
use bigs_ops::groups::Group;
use bigs_ops::pose::Subject;
use bigs_ops::touch::{Object, Touch, Touched};
use numpy::{Element, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::convert::{contiguous, gradient, is_single, rows, slice};
use crate::poses::{held, records};
use crate::{Kind, run, value_error};

fn grid<'a, T: Element + Copy>(
    values: &'a PyReadonlyArrayDyn<'_, T>,
    bounds: &'a PyReadonlyArrayDyn<'_, T>,
) -> PyResult<Grid<'a, T>> {
    let &[lower, upper] = rows("bounds", bounds)? else {
        return Err(PyValueError::new_err("bounds: expected two rows"));
    };
    let &[z, y, x] = values.shape() else {
        return Err(PyValueError::new_err(format!(
            "values: expected three axes, found shape {:?}",
            values.shape()
        )));
    };
    Ok(Grid {
        values: contiguous("values", values)?,
        size: [x, y, z],
        bounds: [lower, upper],
    })
}

fn measured<'py, T: Kind>(py: Python<'py>, arrays: &Bound<'py, PyTuple>) -> PyResult<Bound<'py, PyAny>> {
    let [points, values, bounds] = held::<T, 3>(["points", "values", "bounds"], arrays)?;
    let (grid, points) = (grid(&values, &bounds)?, rows("points", &points)?);
    Ok(gradient(py, run(py, || grid.distances(points))?).into_any())
}

/// Flat distances of points; `arrays` is (points `[.., 3]`, values `[Z, Y, X]`, bounds `[2, 3]`), C-contiguous, float32 or
/// float64 throughout. Raises ValueError.
#[pyfunction]
pub(crate) fn distances<'py>(py: Python<'py>, arrays: &Bound<'py, PyTuple>) -> PyResult<Bound<'py, PyAny>> {
    if is_single(arrays) {
        measured::<f32>(py, arrays)
    } else {
        measured::<f64>(py, arrays)
    }
}

/// What touches, for the backward pass. Opaque; usable any number of times.
#[pyclass(frozen, module = "bigs._raster")]
pub(crate) struct TouchState {
    kept: Kept,
}

enum Kept {
    Single(Touched<f32>),
    Double(Touched<f64>),
}

const TOUCH: [&str; 8] = [
    "points",
    "weights",
    "bones",
    "rotations",
    "centers",
    "scale",
    "values",
    "bounds",
];

/// What else a call says: whether the hand is mirrored, for each group how many of which vertices count, and the tolerance.
type Options = (bool, Vec<(usize, Option<Vec<usize>>)>, f64);

fn touch_of<'a, T: Kind>(
    [points, weights, bones, rotations, centers, scale, values, bounds]: &'a [PyReadonlyArrayDyn<'_, T>; 8],
    (mirrored, groups, tolerance): Options,
) -> PyResult<Touch<'a, T>> {
    let &[scale] = contiguous("scale", scale)? else {
        return Err(PyValueError::new_err("scale: expected one value"));
    };
    let hand = Subject {
        count: weights.shape().first().copied().unwrap_or(0),
        points: rows("points", points)?,
        weights: contiguous("weights", weights)?,
        bones: contiguous("bones", bones)?,
        bone_size: bones.shape().iter().rev().take(2).product(),
        mirrored,
        surface: None,
    };
    let object = Object {
        grid: grid(values, bounds)?,
        rotations: records("rotations", rotations)?,
        centers: rows("centers", centers)?,
        scale,
    };
    let groups: Vec<Group> = groups
        .into_iter()
        .map(|(deepest, vertices)| Group { deepest, vertices })
        .collect();
    Touch::new(hand, object, &groups, T::of(tolerance)).map_err(value_error)
}

fn touched<'py, T: Kind>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    options: Options,
    keep: fn(Touched<T>) -> Kept,
) -> PyResult<Bound<'py, PyTuple>> {
    let arrays = held::<T, 8>(TOUCH, arrays)?;
    let touch = touch_of(&arrays, options)?;
    let found = run(py, || touch.measure())?;
    let (depths, sunk) = (
        gradient(py, found.depths.clone()),
        gradient(py, found.sunk.clone()),
    );
    (depths, sunk, TouchState { kept: keep(found) }).into_pyobject(py)
}

/// Flat depths `[B, G]`, sums of squares `[B]` of what is sunk, and a state for the backward pass.
///
/// `arrays` is (points `[V, 3]` or `[B, V, 3]`, weights `[V, K]`, bones `[B, K, 3 or 4, 4]`, rotations `[B, 3, 3]`, centers
/// `[B, 3]`, scale `[]`, values `[Z, Y, X]`, bounds `[2, 3]`), C-contiguous, float32 or float64 throughout; `options` is
/// whether the hand is mirrored, for each of G groups how many of which vertices count (None for all), and the tolerance.
/// Raises ValueError.
#[pyfunction]
pub(crate) fn touch_forward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    options: Options,
) -> PyResult<Bound<'py, PyTuple>> {
    if is_single(arrays) {
        touched(py, arrays, options, Kept::Single)
    } else {
        touched(py, arrays, options, Kept::Double)
    }
}

fn touch_back<'py, T: Kind>(
    py: Python<'py>,
    touched: &Touched<T>,
    arrays: &Bound<'py, PyTuple>,
    options: Options,
    [v_depths, v_sunk]: [Option<&Bound<'py, PyAny>>; 2],
) -> PyResult<Bound<'py, PyTuple>> {
    let arrays = held::<T, 8>(TOUCH, arrays)?;
    let touch = touch_of(&arrays, options)?;
    let v_depths = v_depths.map(|v| slice::<T>("v_depths", v)).transpose()?;
    let v_sunk = v_sunk.map(|v| slice::<T>("v_sunk", v)).transpose()?;
    let v_depths = v_depths.as_ref().map(|v| contiguous("v_depths", v)).transpose()?;
    let v_sunk = v_sunk.as_ref().map(|v| contiguous("v_sunk", v)).transpose()?;
    let found = run(py, || touch.vjp(touched, v_depths, v_sunk))?;
    (
        gradient(py, found.points.into_flattened()),
        gradient(py, found.bones),
        gradient(py, found.rotations.into_flattened()),
        gradient(py, found.centers.into_flattened()),
        gradient(py, vec![found.scale]),
    )
        .into_pyobject(py)
}

/// Flat gradients of points, bones, rotations, centers and scale from those of depths and sums, either of which may be
/// None.
#[pyfunction]
pub(crate) fn touch_backward<'py>(
    py: Python<'py>,
    state: &Bound<'py, TouchState>,
    arrays: &Bound<'py, PyTuple>,
    options: Options,
    pulls: [Option<Bound<'py, PyAny>>; 2],
) -> PyResult<Bound<'py, PyTuple>> {
    let pulls = [0, 1].map(|i| pulls[i].as_ref());
    match &state.get().kept {
        Kept::Single(touched) => touch_back(py, touched, arrays, options, pulls),
        Kept::Double(touched) => touch_back(py, touched, arrays, options, pulls),
    }
}

//! What the turns of finger joints cost: the Python face of `bigs_ops::fingers`.

use bigs_ops::fingers::{Costs, Fingers};
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::convert::{gradient, is_single};
use crate::poses::{held, records};
use crate::{Kind, run};

/// Hands fingers of borrowed arrays to `work`.
fn with_fingers<T: Kind, R>(
    arrays: &Bound<'_, PyTuple>,
    work: impl FnOnce(Fingers<'_, T>) -> PyResult<R>,
) -> PyResult<R> {
    let [rotations, impossible, bends] = held::<T, 3>(["hand_pose", "turns", "bends"], arrays)?;
    work(Fingers {
        rotations: records("hand_pose", &rotations)?,
        impossible: records("turns", &impossible)?,
        bends: records("bends", &bends)?,
    })
}

fn costs<'py, T: Kind>(py: Python<'py>, arrays: &Bound<'py, PyTuple>) -> PyResult<Bound<'py, PyTuple>> {
    with_fingers::<T, _>(arrays, |fingers| {
        let found = run(py, || fingers.costs())?;
        let [unevenness, impossible, uncoupled] =
            [found.unevenness, found.impossible, found.uncoupled].map(|cost| gradient(py, vec![cost]));
        (unevenness, impossible, uncoupled).into_pyobject(py)
    })
}

/// Unevenness, squared impossible turns and departures from coupled bends, an array of one value each.
///
/// `arrays` is (hand_pose `[B, 15, 3, 3]`, turns `[M, 15, 3, 3]`, bends `[2, 2, 4, 15, 3, 3]`), C-contiguous, float32 or float64
/// throughout. Raises ValueError.
#[pyfunction]
pub(crate) fn finger_costs_forward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
) -> PyResult<Bound<'py, PyTuple>> {
    if is_single(arrays) {
        costs::<f32>(py, arrays)
    } else {
        costs::<f64>(py, arrays)
    }
}

fn costs_back<'py, T: Kind>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    [unevenness, impossible, uncoupled]: [f64; 3],
) -> PyResult<Bound<'py, PyAny>> {
    with_fingers::<T, _>(arrays, |fingers| {
        let pulls = Costs {
            unevenness: T::of(unevenness),
            impossible: T::of(impossible),
            uncoupled: T::of(uncoupled),
        };
        let found = run(py, || fingers.vjp(pulls))?;
        Ok(gradient(py, found.into_flattened()).into_any())
    })
}

/// Flat gradients of hand_pose from those of the three costs.
#[pyfunction]
pub(crate) fn finger_costs_backward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    pulls: [f64; 3],
) -> PyResult<Bound<'py, PyAny>> {
    if is_single(arrays) {
        costs_back::<f32>(py, arrays, pulls)
    } else {
        costs_back::<f64>(py, arrays, pulls)
    }
}

//! A hand's poses from what was learned: the Python face of `bigs_ops::hand_poses`.

use bigs_ops::hand_poses::{HandPoses, Held, PosePulls, Residuals, Start};
use numpy::PyReadonlyArrayDyn;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::convert::{contiguous, gradient, is_single, rows, slice};
use crate::poses::{held, records};
use crate::{Kind, run};

const OWN: [&str; 9] = [
    "base_orient",
    "base_pose",
    "base_ray",
    "base_log_depth",
    "orient",
    "pose",
    "pose_bias",
    "ray",
    "log_depth",
];

const GRASPS: [&str; 9] = [
    "grasps' base_orient",
    "grasps' base_pose",
    "grasps' base_position",
    "grasps' orient",
    "grasps' pose",
    "grasps' position",
    "rotations",
    "centers",
    "scale",
];

/// Arrays of grasps and of what carries them, each frame's grasp, the slack, and whether the hand is mirrored.
type Carried<'py> = (Bound<'py, PyTuple>, Bound<'py, PyAny>, f64, bool);

/// Hands poses of borrowed arrays to `work`.
fn with_poses<'py, T: Kind, R>(
    arrays: &Bound<'py, PyTuple>,
    frames: &[usize],
    carried: Option<&Carried<'py>>,
    work: impl FnOnce(&HandPoses<'_, T>) -> PyResult<R>,
) -> PyResult<R> {
    let own = held::<T, 9>(OWN, arrays)?;
    let [
        base_orient,
        base_pose,
        base_ray,
        base_log_depth,
        orient,
        pose,
        pose_bias,
        ray,
        log_depth,
    ] = &own;
    let mut poses = HandPoses {
        frames,
        start: Start {
            orient: records("base_orient", base_orient)?,
            fingers: records("base_pose", base_pose)?,
            ray: rows("base_ray", base_ray)?,
            log_depth: contiguous("base_log_depth", base_log_depth)?,
        },
        residuals: Residuals {
            orient: rows("orient", orient)?,
            fingers: rows("pose", pose)?,
            bias: rows("pose_bias", pose_bias)?,
            ray: rows("ray", ray)?,
            log_depth: contiguous("log_depth", log_depth)?,
        },
        held: None,
    };
    let Some((arrays, of_frame, slack, mirrored)) = carried else {
        return work(&poses);
    };
    let grasps = held::<T, 9>(GRASPS, arrays)?;
    let [
        base_orient,
        base_pose,
        base_position,
        orient,
        pose,
        position,
        rotations,
        centers,
        scale,
    ] = &grasps;
    let of_frame: PyReadonlyArrayDyn<'py, i64> = slice("of_frame", of_frame)?;
    let &[scale] = contiguous("scale", scale)? else {
        return Err(PyValueError::new_err("scale: expected one value"));
    };
    poses.held = Some(Held {
        of_frame: contiguous("of_frame", &of_frame)?,
        slack: T::of(*slack),
        mirrored: *mirrored,
        base_orient: records(GRASPS[0], base_orient)?,
        base_fingers: records(GRASPS[1], base_pose)?,
        base_position: rows(GRASPS[2], base_position)?,
        orient: rows(GRASPS[3], orient)?,
        fingers: rows(GRASPS[4], pose)?,
        position: rows(GRASPS[5], position)?,
        rotations: records("rotations", rotations)?,
        centers: rows("centers", centers)?,
        scale,
    });
    work(&poses)
}

fn forward<'py, T: Kind>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    frames: &[usize],
    carried: Option<&Carried<'py>>,
) -> PyResult<Bound<'py, PyTuple>> {
    with_poses::<T, _>(arrays, frames, carried, |poses| {
        let posed = run(py, || poses.pose())?;
        (
            gradient(py, posed.orient.into_flattened()),
            gradient(py, posed.fingers.into_flattened()),
            gradient(py, posed.wrist.into_flattened()),
        )
            .into_pyobject(py)
    })
}

/// Flat rotations `[B, 3, 3]` and `[B, J, 3, 3]` and wrists `[B, 3]` of some of T frames.
///
/// `arrays` is (base_orient `[T, 3, 3]`, base_pose `[T, J, 3, 3]`, base_ray `[T, 2]`, base_log_depth `[T]`, orient `[T, 3]`,
/// pose `[T, J, 3]`, pose_bias `[J, 3]`, ray `[T, 2]`, log_depth `[T]`); `carried` is None or a tuple of (base_orient `[G, 3, 3]`,
/// base_pose `[G, J, 3, 3]`, base_position `[G, 3]`, orient `[G, 3]`, pose `[G, J, 3]`, position `[G, 3]`, rotations `[B, 3, 3]`,
/// centers `[B, 3]`, scale `[]`), of_frame `[T]` int64, slack, and whether the hand is mirrored. Raises ValueError.
#[pyfunction]
pub(crate) fn hand_poses_forward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    frames: Vec<usize>,
    carried: Option<Carried<'py>>,
) -> PyResult<Bound<'py, PyTuple>> {
    if is_single(arrays) {
        forward::<f32>(py, arrays, &frames, carried.as_ref())
    } else {
        forward::<f64>(py, arrays, &frames, carried.as_ref())
    }
}

fn backward<'py, T: Kind>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    frames: &[usize],
    carried: Option<&Carried<'py>>,
    [orient, pose, wrist]: [Option<&Bound<'py, PyAny>>; 3],
) -> PyResult<Bound<'py, PyTuple>> {
    let orient = orient.map(|v| slice::<T>("v_orient", v)).transpose()?;
    let pose = pose.map(|v| slice::<T>("v_pose", v)).transpose()?;
    let wrist = wrist.map(|v| slice::<T>("v_wrist", v)).transpose()?;
    let pulls = PosePulls {
        orient: orient.as_ref().map(|v| records("v_orient", v)).transpose()?,
        fingers: pose.as_ref().map(|v| records("v_pose", v)).transpose()?,
        wrist: wrist.as_ref().map(|v| rows("v_wrist", v)).transpose()?,
    };
    with_poses::<T, _>(arrays, frames, carried, |poses| {
        let found = run(py, || poses.vjp(pulls))?;
        let own = (
            gradient(py, found.orient.into_flattened()),
            gradient(py, found.fingers.into_flattened()),
            gradient(py, found.bias.into_flattened()),
            gradient(py, found.ray.into_flattened()),
            gradient(py, found.log_depth),
        );
        let held = found.held.map(|held| {
            (
                gradient(py, held.orient.into_flattened()),
                gradient(py, held.fingers.into_flattened()),
                gradient(py, held.position.into_flattened()),
                gradient(py, held.rotations.into_flattened()),
                gradient(py, held.centers.into_flattened()),
                gradient(py, vec![held.scale]),
            )
        });
        (own, held).into_pyobject(py)
    })
}

/// Flat gradients of orient, pose, pose_bias, ray and log_depth, and, with grasps, of their orient, pose and position and of
/// rotations, centers and scale, from those of the poses, any of which may be None.
#[pyfunction]
pub(crate) fn hand_poses_backward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    frames: Vec<usize>,
    carried: Option<Carried<'py>>,
    pulls: [Option<Bound<'py, PyAny>>; 3],
) -> PyResult<Bound<'py, PyTuple>> {
    let pulls = [0, 1, 2].map(|i| pulls[i].as_ref());
    if is_single(arrays) {
        backward::<f32>(py, arrays, &frames, carried.as_ref(), pulls)
    } else {
        backward::<f64>(py, arrays, &frames, carried.as_ref(), pulls)
    }
}

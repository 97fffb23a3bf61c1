//! Posing: the Python face of `bigs_ops::pose`.

use bigs_ops::pose::{Ambient, Light, Pose, Subject, Surface, Wanted};
use numpy::{Element, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyList, PyTuple};

use crate::Kind;
use crate::convert::{contiguous, gradient, is_single, rows, slice};
use crate::{run, value_error};

/// Arrays of a subject, borrowed for as long as this lives.
struct Held<'py, T: Element> {
    points: PyReadonlyArrayDyn<'py, T>,
    weights: PyReadonlyArrayDyn<'py, T>,
    bones: PyReadonlyArrayDyn<'py, T>,
    /// Quaternions and albedo.
    surface: Option<[PyReadonlyArrayDyn<'py, T>; 2]>,
    /// Parts and shade.
    light: Option<[PyReadonlyArrayDyn<'py, T>; 2]>,
    /// Occlusion and its strength.
    ambient: Option<[PyReadonlyArrayDyn<'py, T>; 2]>,
    mirrored: bool,
}

impl<'py, T: Kind> Held<'py, T> {
    /// Reads (points, weights, bones, quats | None, albedo | None, parts | None, shade | None, occlusion | None,
    /// ambient | None, mirrored).
    fn extract(subject: &Bound<'py, PyTuple>) -> PyResult<Self> {
        if subject.len() != 10 {
            return Err(PyTypeError::new_err("subject: expected ten entries"));
        }
        let two = |names: [&str; 2], at: usize| -> PyResult<Option<[PyReadonlyArrayDyn<'py, T>; 2]>> {
            let first = subject.get_item(at)?;
            if first.is_none() {
                return Ok(None);
            }
            let second = subject.get_item(at + 1)?;
            Ok(Some([slice(names[0], &first)?, slice(names[1], &second)?]))
        };
        Ok(Self {
            points: slice("points", &subject.get_item(0)?)?,
            weights: slice("weights", &subject.get_item(1)?)?,
            bones: slice("bones", &subject.get_item(2)?)?,
            surface: two(["quats", "albedo"], 3)?,
            light: two(["parts", "shade"], 5)?,
            ambient: two(["occlusion", "ambient"], 7)?,
            mirrored: subject.get_item(9)?.extract()?,
        })
    }

    fn subject(&self) -> PyResult<Subject<'_, T>> {
        let ambient = match &self.ambient {
            None => None,
            Some([occlusion, strength]) => {
                let &[strength] = rows("ambient", strength)? else {
                    return Err(PyValueError::new_err("ambient: expected one row"));
                };
                Some(Ambient {
                    occlusion: contiguous("occlusion", occlusion)?,
                    strength,
                })
            }
        };
        let light = match &self.light {
            None => None,
            Some([parts, shade]) => Some(Light {
                parts_each: parts.shape().last().copied().unwrap_or(0),
                parts: contiguous("parts", parts)?,
                shade: contiguous("shade", shade)?,
                ambient,
            }),
        };
        let surface = match &self.surface {
            None => None,
            Some([quats, albedo]) => Some(Surface {
                quats: rows("quats", quats)?,
                albedo: rows("albedo", albedo)?,
                light,
            }),
        };
        Ok(Subject {
            count: self.weights.shape().first().copied().unwrap_or(0),
            points: rows("points", &self.points)?,
            weights: contiguous("weights", &self.weights)?,
            bones: contiguous("bones", &self.bones)?,
            bone_size: self.bones.shape().iter().rev().take(2).product(),
            mirrored: self.mirrored,
            surface,
        })
    }
}

/// Subjects and the clip's light.
struct Scene<'py, T: Element> {
    frames: usize,
    subjects: Vec<Held<'py, T>>,
    clip: Option<PyReadonlyArrayDyn<'py, T>>,
    labels: bool,
}

impl<'py, T: Kind> Scene<'py, T> {
    fn extract(
        frames: usize,
        subjects: &[Bound<'py, PyTuple>],
        clip: Option<&Bound<'py, PyAny>>,
        labels: bool,
    ) -> PyResult<Self> {
        Ok(Self {
            frames,
            subjects: subjects.iter().map(Held::extract).collect::<PyResult<_>>()?,
            clip: clip.map(|clip| slice("clip", clip)).transpose()?,
            labels,
        })
    }

    fn pose(&self) -> PyResult<Pose<'_, T>> {
        let clip = self.clip.as_ref().map(|clip| rows("clip", clip)).transpose()?;
        let subjects = self.subjects.iter().map(Held::subject).collect::<PyResult<_>>()?;
        Pose::new(self.frames, subjects, clip, self.labels).map_err(value_error)
    }

    fn forward(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let pose = self.pose()?;
        let posed = run(py, || pose.forward())?;
        (
            gradient(py, posed.means.into_flattened()),
            gradient(py, posed.quats.into_flattened()),
            gradient(py, posed.colors),
        )
            .into_pyobject(py)
    }

    fn backward(
        &self,
        py: Python<'py>,
        pulls: [Option<&Bound<'py, PyAny>>; 3],
        wanted: &[Wanted],
    ) -> PyResult<Bound<'py, PyTuple>> {
        let pose = self.pose()?;
        let names = ["v_means", "v_quats", "v_colors"];
        let held = [0, 1, 2].map(|i| pulls[i].map(|v| slice::<T>(names[i], v)).transpose());
        let [means, quats, colors] = held;
        let (means, quats, colors) = (means?, quats?, colors?);
        let means = means.as_ref().map(|v| rows("v_means", v)).transpose()?;
        let quats = quats.as_ref().map(|v| rows("v_quats", v)).transpose()?;
        let colors = colors.as_ref().map(|v| contiguous("v_colors", v)).transpose()?;
        let gradients = run(py, || pose.vjp(means, quats, colors, wanted))?;
        let subjects = gradients
            .subjects
            .into_iter()
            .map(|own| {
                (
                    gradient(py, own.points.into_flattened()),
                    gradient(py, own.weights),
                    gradient(py, own.bones),
                    gradient(py, own.quats.into_flattened()),
                    gradient(py, own.albedo.into_flattened()),
                    gradient(py, own.shade),
                    gradient(py, own.strength.to_vec()),
                )
                    .into_pyobject(py)
            })
            .collect::<PyResult<Vec<_>>>()?;
        (
            PyList::new(py, subjects)?,
            gradient(py, gradients.clip.as_flattened().to_vec()),
        )
            .into_pyobject(py)
    }
}

/// Whether arrays are float32.
fn are_single(subjects: &[Bound<'_, PyTuple>]) -> bool {
    subjects.first().is_some_and(is_single)
}

/// Carries subjects to `frames` frames.
///
/// A subject is (points `[N, 3]` or `[B, N, 3]`, weights `[N, K]`, bones `[B, K, 3 or 4, 4]`, quats `[N, 4]` or None,
/// albedo `[N, 3]` or None, parts `[N, J]` or None, shade `[B, 4 + J]` or None, occlusion `[B, N]`
/// or None, ambient `[3]` or None, mirrored); clip is `[8, 3]` or None. All are
/// C-contiguous, float32 or float64 throughout.
///
/// Returns (means, quats, colors), flat. Raises ValueError.
#[pyfunction]
pub(crate) fn pose_forward<'py>(
    py: Python<'py>,
    frames: usize,
    subjects: Vec<Bound<'py, PyTuple>>,
    clip: Option<Bound<'py, PyAny>>,
    labels: bool,
) -> PyResult<Bound<'py, PyTuple>> {
    if are_single(&subjects) {
        Scene::<f32>::extract(frames, &subjects, clip.as_ref(), labels)?.forward(py)
    } else {
        Scene::<f64>::extract(frames, &subjects, clip.as_ref(), labels)?.forward(py)
    }
}

/// Gradients of each subject's points, weights, bones, quats, albedo, shade and ambient, flat, and of the clip's light; what
/// is not wanted is an empty array, or zeros for ambient. Takes the arguments of the forward call and the gradients of its results or None.
#[pyfunction]
pub(crate) fn pose_backward<'py>(
    py: Python<'py>,
    frames: usize,
    subjects: Vec<Bound<'py, PyTuple>>,
    clip: Option<Bound<'py, PyAny>>,
    labels: bool,
    pulls: [Option<Bound<'py, PyAny>>; 3],
    wanted: Vec<[bool; 6]>,
) -> PyResult<Bound<'py, PyTuple>> {
    let wanted: Vec<Wanted> = wanted
        .into_iter()
        .map(|[points, weights, bones, quats, albedo, light]| Wanted {
            points,
            weights,
            bones,
            quats,
            albedo,
            light,
        })
        .collect();
    let pulls = [0, 1, 2].map(|i| pulls[i].as_ref());
    if are_single(&subjects) {
        Scene::<f32>::extract(frames, &subjects, clip.as_ref(), labels)?.backward(py, pulls, &wanted)
    } else {
        Scene::<f64>::extract(frames, &subjects, clip.as_ref(), labels)?.backward(py, pulls, &wanted)
    }
}

//! Bundle adjustment: the Python face of `bigs_track`'s.

use bigs_track::{Equations, Scene, Sightings, TrackError};
use numpy::PyReadonlyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::call;
use crate::convert::{contiguous, gradient, mask, rows, slice};
use crate::track::refused;

fn run<R: Send>(py: Python<'_>, work: impl FnOnce() -> Result<R, TrackError> + Send) -> PyResult<R> {
    call::run(py, "bundle adjustment", refused, work)
}

/// A scene's arrays, borrowed for as long as this lives.
pub(crate) struct Arrays<'py> {
    rotations: PyReadonlyArrayDyn<'py, f64>,
    transl: PyReadonlyArrayDyn<'py, f64>,
    points: PyReadonlyArrayDyn<'py, f64>,
    camera: [f64; 4],
}

impl<'a, 'py> FromPyObject<'a, 'py> for Arrays<'py> {
    type Error = PyErr;

    /// Reads (rotations `[T, 9]`, transl `[T, 3]`, points `[P, 3]`, focal lengths and principal point [4]).
    fn extract(object: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let (rotations, transl, points, camera): (
            Bound<'py, PyAny>,
            Bound<'py, PyAny>,
            Bound<'py, PyAny>,
            [f64; 4],
        ) = object.extract()?;
        Ok(Self {
            rotations: slice("rotations", &rotations)?,
            transl: slice("transl", &transl)?,
            points: slice("points", &points)?,
            camera,
        })
    }
}

impl Arrays<'_> {
    fn scene(&self, sigma: f64) -> PyResult<Scene<'_>> {
        let [fx, fy, cx, cy] = self.camera;
        Ok(Scene {
            rotations: rows("rotations", &self.rotations)?,
            transl: rows("transl", &self.transl)?,
            points: rows("points", &self.points)?,
            focal: [fx, fy],
            middle: [cx, cy],
            sigma,
        })
    }
}

/// What was seen where, for bundle adjustment. Opaque.
///
/// A scene is (rotations `[T, 9]`, transl `[T, 3]`, points `[P, 3]` by rank, fx fy cx cy); a coupling has 12 numbers.
#[pyclass(frozen, module = "bigs._raster")]
pub(crate) struct BundleSightings {
    seen: Sightings,
}

#[pymethods]
impl BundleSightings {
    /// Observations by rank of their point and then by frame: frame and rank `[M]`, pixels `[M, 2]`, precision `[M, 3]`;
    /// `free` `[T]` says which frames may move. Raises ValueError.
    #[new]
    fn new(
        py: Python<'_>,
        frame: &Bound<'_, PyAny>,
        point: &Bound<'_, PyAny>,
        pixels: &Bound<'_, PyAny>,
        precision: &Bound<'_, PyAny>,
        free: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let (frame, point) = (slice::<i64>("frame", frame)?, slice::<i64>("point", point)?);
        let (pixels, precision) = (slice("pixels", pixels)?, slice("precision", precision)?);
        let (frame, point) = (contiguous("frame", &frame)?, contiguous("point", &point)?);
        let pixels: &[[f64; 2]] = rows("pixels", &pixels)?;
        let precision: &[[f64; 3]] = rows("precision", &precision)?;
        let free = mask("free", free)?;
        let seen = run(py, || {
            Sightings::new(frame, point, pixels.to_vec(), precision.to_vec(), &free)
        })?;
        Ok(Self { seen })
    }

    /// The sum of Cauchy's losses of scale `sigma` pixels. Raises ValueError.
    fn cost(&self, py: Python<'_>, scene: Arrays<'_>, sigma: f64) -> PyResult<f64> {
        let scene = scene.scene(sigma)?;
        run(py, || self.seen.cost(&scene))
    }

    /// Normal equations, flat: of the poses `[6F * 6F]` and their gradient `[6F]`, of the points `[P * 9]` and their
    /// gradient `[P * 3]`, and couplings `[M * 12]`. Raises ValueError.
    fn linearise<'py>(
        &self,
        py: Python<'py>,
        scene: Arrays<'py>,
        sigma: f64,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let scene = scene.scene(sigma)?;
        let system = run(py, || self.seen.linearise(&scene))?;
        PyTuple::new(
            py,
            [
                system.poses,
                system.pose_gradient,
                system.points.into_flattened(),
                system.point_gradient.into_flattened(),
                system.couplings.into_flattened(),
            ]
            .map(|values| gradient(py, values)),
        )
    }

    /// The focal length's part of the normal equations, flat: with the poses `[6F]` and the points `[P * 3]`, its second
    /// derivative and its first. Raises ValueError.
    fn border<'py>(&self, py: Python<'py>, scene: Arrays<'py>, sigma: f64) -> PyResult<Bound<'py, PyTuple>> {
        let scene = scene.scene(sigma)?;
        let border = run(py, || self.seen.border(&scene))?;
        (
            gradient(py, border.poses),
            gradient(py, border.points.into_flattened()),
            border.stiffness,
            border.gradient,
        )
            .into_pyobject(py)
    }

    /// The poses' equations without the points: matrix `[6F * 6F]`, gradient `[6F]`, and the inverses of the points'
    /// matrices `[P * 9]`, flat; `system` is as `linearise` makes it, in rows. Raises ValueError.
    fn reduce<'py>(
        &self,
        py: Python<'py>,
        system: [Bound<'py, PyAny>; 5],
        damping: f64,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let [poses, pose_gradient, points, point_gradient, couplings] = &system;
        let poses = slice("poses", poses)?;
        let pose_gradient = slice("pose_gradient", pose_gradient)?;
        let points = slice("points", points)?;
        let point_gradient = slice("point_gradient", point_gradient)?;
        let couplings = slice("couplings", couplings)?;
        let equations = Equations {
            poses: contiguous("poses", &poses)?,
            pose_gradient: contiguous("pose_gradient", &pose_gradient)?,
            points: rows("points", &points)?,
            point_gradient: rows("point_gradient", &point_gradient)?,
            couplings: rows("couplings", &couplings)?,
        };
        let reduced = run(py, || self.seen.reduce(&equations, damping))?;
        PyTuple::new(
            py,
            [
                reduced.matrix,
                reduced.gradient,
                reduced.inverses.into_flattened(),
            ]
            .map(|values| gradient(py, values)),
        )
    }

    /// How far points go `[P * 3]` when the poses go by `change` `[F, 6]`, from couplings `[M, 12]`, the points' gradient
    /// `[P, 3]` and inverses `[P, 9]`. Raises ValueError.
    fn point_steps<'py>(
        &self,
        py: Python<'py>,
        couplings: &Bound<'py, PyAny>,
        point_gradient: &Bound<'py, PyAny>,
        inverses: &Bound<'py, PyAny>,
        change: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let couplings = slice("couplings", couplings)?;
        let point_gradient = slice("point_gradient", point_gradient)?;
        let inverses = slice("inverses", inverses)?;
        let change = slice("change", change)?;
        let (couplings, inverses) = (rows("couplings", &couplings)?, rows("inverses", &inverses)?);
        let point_gradient = rows("point_gradient", &point_gradient)?;
        let change = rows("change", &change)?;
        let steps = run(py, || {
            self.seen.point_steps(couplings, point_gradient, inverses, change)
        })?;
        Ok(gradient(py, steps.into_flattened()).into_any())
    }

    /// What `values` `[P, 3]` of the points do in the poses' equations `[6F]`, by couplings `[M, 12]`. Raises ValueError.
    fn carried<'py>(
        &self,
        py: Python<'py>,
        couplings: &Bound<'py, PyAny>,
        values: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (couplings, values) = (slice("couplings", couplings)?, slice("values", values)?);
        let (couplings, values) = (rows("couplings", &couplings)?, rows("values", &values)?);
        let sums = run(py, || self.seen.carried(couplings, values))?;
        Ok(gradient(py, sums).into_any())
    }
}

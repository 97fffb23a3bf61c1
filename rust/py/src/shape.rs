//! What views say of an object's shape: the Python face of `bigs_shape`.

use bigs_shape::{Cones, Empty, Facing, Judge, Kind, Neighbours, Samples, ShapeError, Symmetry, Vec3, Views};
use numpy::{PyArray1, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use crate::call;
use crate::convert::{contiguous, gradient, rows, slice};

fn refused(error: ShapeError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

fn run<R: Send>(py: Python<'_>, work: impl FnOnce() -> Result<R, ShapeError> + Send) -> PyResult<R> {
    call::run(py, "measuring a shape", refused, work)
}

/// Poses and camera of T pictures, borrowed for as long as this lives.
pub(crate) struct Poses<'py> {
    camera: [f64; 4],
    rotations: PyReadonlyArrayDyn<'py, f64>,
    centers: PyReadonlyArrayDyn<'py, f64>,
}

impl<'a, 'py> FromPyObject<'a, 'py> for Poses<'py> {
    type Error = PyErr;

    /// Reads (focal lengths and principal point [4], rotations `[T, 9]`, centres `[T, 3]`).
    fn extract(object: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let (camera, rotations, centers): ([f64; 4], Bound<'py, PyAny>, Bound<'py, PyAny>) =
            object.extract()?;
        Ok(Self {
            camera,
            rotations: slice("rotations", &rotations)?,
            centers: slice("centers", &centers)?,
        })
    }
}

impl Poses<'_> {
    /// The views whose pictures an array [T, H, W] holds.
    fn views(&self, what: &str, shape: &[usize]) -> PyResult<Views<'_>> {
        let &[_, height, width] = shape else {
            return Err(PyValueError::new_err(format!(
                "{what}: expected the shape (T, H, W), found {shape:?}"
            )));
        };
        let [fx, fy, cx, cy] = self.camera;
        Ok(Views {
            width,
            height,
            focal: [fx, fy],
            middle: [cx, cy],
            rotations: rows("rotations", &self.rotations)?,
            centers: rows("centers", &self.centers)?,
        })
    }
}

/// Distances `[N]` of `points` `[N, 3]` to the visual hull of `silhouettes` `[T, H, W]`. Raises ValueError.
///
/// Pictures are looked at in `order` `[T]`; `agreeing` of them must say that a point is outside, and one that is further
/// outside than `stop` is not looked at again.
#[pyfunction]
pub(crate) fn cone_distances<'py>(
    py: Python<'py>,
    silhouettes: &Bound<'py, PyAny>,
    poses: Poses<'py>,
    points: &Bound<'py, PyAny>,
    order: Vec<usize>,
    agreeing: usize,
    stop: f64,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let (silhouettes, points) = (slice("silhouettes", silhouettes)?, slice("points", points)?);
    let views = poses.views("silhouettes", silhouettes.shape())?;
    let cones = Cones {
        silhouettes: contiguous("silhouettes", &silhouettes)?,
        order: &order,
        agreeing,
        stop,
    };
    let points = rows("points", &points)?;
    Ok(gradient(py, run(py, || views.cones(&cones, points))?))
}

/// In how many pictures `[N]` points of a surface show, given its normals and samples `[M, 3]`. Raises ValueError.
#[pyfunction]
pub(crate) fn times_seen<'py>(
    py: Python<'py>,
    shown: &Bound<'py, PyAny>,
    poses: Poses<'py>,
    points: &Bound<'py, PyAny>,
    normals: &Bound<'py, PyAny>,
    surface: &Bound<'py, PyAny>,
    least_cosine: f64,
    tolerance: f64,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let (shown, points) = (slice("shown", shown)?, slice("points", points)?);
    let (normals, surface) = (slice("normals", normals)?, slice("surface", surface)?);
    let views = poses.views("shown", shown.shape())?;
    let facing = Facing {
        normals: rows("normals", &normals)?,
        least_cosine,
    };
    let (shown, points) = (contiguous("shown", &shown)?, rows("points", &points)?);
    let surface: &[Vec3] = rows("surface", &surface)?;
    let counts = run(py, || {
        views.times_seen(shown, points, &facing, surface, tolerance)
    })?;
    Ok(gradient(py, counts))
}

/// In how many pictures `[N]` points `[N, 3]` would hide surface `[M, 3]` that shows. Raises ValueError.
#[pyfunction]
pub(crate) fn times_empty<'py>(
    py: Python<'py>,
    shown: &Bound<'py, PyAny>,
    poses: Poses<'py>,
    points: &Bound<'py, PyAny>,
    surface: &Bound<'py, PyAny>,
    tolerance: f64,
) -> PyResult<Bound<'py, PyArray1<u32>>> {
    let (shown, points) = (slice("shown", shown)?, slice("points", points)?);
    let surface = slice("surface", surface)?;
    let views = poses.views("shown", shown.shape())?;
    let (shown, points) = (contiguous("shown", &shown)?, rows("points", &points)?);
    let surface: &[Vec3] = rows("surface", &surface)?;
    let counts = run(py, || views.times_empty(shown, points, surface, tolerance))?;
    Ok(gradient(py, counts))
}

/// The largest signed distance `[N]` of points `[N, 3]` to planes `[M, 4]`: normal and offset. Raises ValueError.
#[pyfunction]
pub(crate) fn beyond_planes<'py>(
    py: Python<'py>,
    points: &Bound<'py, PyAny>,
    planes: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let (points, planes) = (slice("points", points)?, slice("planes", planes)?);
    let (points, planes): (&[Vec3], &[[f64; 4]]) = (rows("points", &points)?, rows("planes", &planes)?);
    let distances = run(py, || Ok(bigs_shape::beyond_planes(points, planes)))?;
    Ok(gradient(py, distances))
}

/// Signed distances in pixels from each pixel of a mask `[H, W]` to its border, negative inside. Raises ValueError.
#[pyfunction]
pub(crate) fn border_distances<'py>(
    py: Python<'py>,
    inside: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let inside = slice("inside", inside)?;
    let &[height, width] = inside.shape() else {
        return Err(PyValueError::new_err(format!(
            "inside: expected the shape (H, W), found {:?}",
            inside.shape()
        )));
    };
    let pixels = contiguous("inside", &inside)?;
    let distances = run(py, || bigs_shape::border_distances(pixels, width, height))?;
    Ok(gradient(py, distances))
}

/// Judges symmetries of a surface. Opaque; symmetries are rows of a point and a direction, axes or planes.
#[pyclass(frozen, module = "bigs._raster")]
pub(crate) struct SymmetryJudge {
    judge: Judge,
}

#[pymethods]
impl SymmetryJudge {
    /// `surface` are points, normals and colours `[N, 3]`; `empty` `[X, Y, Z]` is above one half where there is no
    /// object, in a grid with its first value at `origin`. A carried sample meets another within `reach` whose normal is
    /// alike; axes are judged by turns of a `turns`-th of the circle and by `every` so many samples. Raises ValueError.
    #[new]
    fn new(
        surface: [Bound<'_, PyAny>; 3],
        empty: &Bound<'_, PyAny>,
        origin: Vec3,
        spacing: f64,
        reach: f64,
        least_cosine: f64,
        turns: usize,
        every: usize,
    ) -> PyResult<Self> {
        let [points, normals, colors] = &surface;
        let copied = |name: &str, array: &Bound<'_, PyAny>| -> PyResult<Vec<Vec3>> {
            let array = slice(name, array)?;
            Ok(rows(name, &array)?.to_vec())
        };
        let samples = Samples {
            points: copied("points", points)?,
            normals: copied("normals", normals)?,
            colors: copied("colors", colors)?,
        };
        let values = slice("empty", empty)?;
        let &[x, y, z] = values.shape() else {
            return Err(PyValueError::new_err(format!(
                "empty: expected the shape (X, Y, Z), found {:?}",
                values.shape()
            )));
        };
        let empty = Empty {
            values: contiguous("empty", &values)?.to_vec(),
            size: [x, y, z],
            origin,
            spacing,
        };
        let judge = Judge::new(samples, empty, (reach, least_cosine), (turns, every)).map_err(refused)?;
        Ok(Self { judge })
    }

    /// Support, contradiction and mean difference of colours of each symmetry: `[M * 3]`. Raises ValueError.
    fn agreement<'py>(
        &self,
        py: Python<'py>,
        axes: Vec<bool>,
        rows: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let symmetries = symmetries(&axes, rows)?;
        let found = run(py, || Ok(self.judge.agreement(&symmetries)))?;
        let flat = found
            .iter()
            .flat_map(|found| [found.support, found.contradiction, found.color_error]);
        Ok(gradient(py, flat.collect()))
    }

    /// Each symmetry moved to where carried samples lie on what they meet; points and directions `[M * 6]`. `size` is
    /// the object's. Raises ValueError.
    fn refined<'py>(
        &self,
        py: Python<'py>,
        axes: Vec<bool>,
        rows: &Bound<'py, PyAny>,
        size: f64,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let symmetries = symmetries(&axes, rows)?;
        let found = run(py, || Ok(self.judge.refined(&symmetries, size)))?;
        let flat = found.iter().flat_map(|found| [found.point, found.direction]);
        Ok(gradient(py, flat.flatten().collect()))
    }
}

/// Points among which nearest ones are found. Opaque.
#[pyclass(frozen, module = "bigs._raster")]
pub(crate) struct NearestPoints {
    tree: Neighbours,
}

#[pymethods]
impl NearestPoints {
    /// `points` are `[M, 3]`, at least one. Raises ValueError.
    #[new]
    fn new(py: Python<'_>, points: &Bound<'_, PyAny>) -> PyResult<Self> {
        let points = slice("points", points)?;
        let points: Vec<Vec3> = rows("points", &points)?.to_vec();
        let tree = run(py, || Neighbours::new(points))?;
        Ok(Self { tree })
    }

    /// Distance and index of the point that is nearest to each of `places` `[N, 3]`; `guesses` `[N]` of the indices save
    /// time. Raises ValueError.
    #[pyo3(signature = (places, guesses=None))]
    fn of<'py>(
        &self,
        py: Python<'py>,
        places: &Bound<'py, PyAny>,
        guesses: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyTuple>> {
        let places = slice("places", places)?;
        let guesses = guesses
            .map(|guesses| slice::<u32>("guesses", guesses))
            .transpose()?;
        let guesses = guesses
            .as_ref()
            .map(|guesses| contiguous("guesses", guesses))
            .transpose()?;
        let places: &[Vec3] = rows("places", &places)?;
        let (distances, indices) = run(py, || self.tree.of(places, guesses))?;
        (gradient(py, distances), gradient(py, indices)).into_pyobject(py)
    }
}

fn symmetries(axes: &[bool], array: &Bound<'_, PyAny>) -> PyResult<Vec<Symmetry>> {
    let array = slice("symmetries", array)?;
    let found: &[[f64; 6]] = rows("symmetries", &array)?;
    if found.len() != axes.len() {
        return Err(PyValueError::new_err(format!(
            "symmetries: expected {} rows, found {}",
            axes.len(),
            found.len()
        )));
    }
    Ok(axes
        .iter()
        .zip(found)
        .map(|(&axis, &[px, py, pz, dx, dy, dz])| Symmetry {
            kind: if axis { Kind::Axis } else { Kind::Plane },
            point: [px, py, pz],
            direction: [dx, dy, dz],
        })
        .collect())
}

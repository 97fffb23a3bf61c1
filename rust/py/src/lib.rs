//! `bigs._raster`: the Python face of `bigs-raster`. Arrays in, arrays out; no algorithm, default or limit lives here.

mod bundle;
mod call;
mod convert;
mod fingers;
mod hand_poses;
mod measure;
mod occlusion;
mod outline;
mod pixels;
mod pose;
mod poses;
mod sh;
mod shape;
mod touch;
mod track;

use bigs_raster::{Batch, BatchState, CameraModel, RasterError, RasterSettings, RenderMode, Wanted};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::convert::{Arrays, Count, Gaussians, array, contiguous, gradient, is_single, slice};

/// What the forward pass keeps for the backward pass. Opaque; usable any number of times.
#[pyclass(frozen, module = "bigs._raster")]
struct RasterState {
    kept: Kept,
}

enum Kept {
    Single(BatchState<f32>),
    Double(BatchState<f64>),
}

/// The scalars that arrays may have.
trait Kind: bigs_raster::Scalar + numpy::Element {
    fn keep(state: BatchState<Self>) -> Kept;
    fn kept(state: &Kept) -> Option<&BatchState<Self>>;
}

impl Kind for f32 {
    fn keep(state: BatchState<Self>) -> Kept {
        Kept::Single(state)
    }
    fn kept(state: &Kept) -> Option<&BatchState<Self>> {
        match state {
            Kept::Single(state) => Some(state),
            Kept::Double(_) => None,
        }
    }
}

impl Kind for f64 {
    fn keep(state: BatchState<Self>) -> Kept {
        Kept::Double(state)
    }
    fn kept(state: &Kept) -> Option<&BatchState<Self>> {
        match state {
            Kept::Double(state) => Some(state),
            Kept::Single(_) => None,
        }
    }
}

/// `bigs.raster.RasterSettings`, read by attribute: a renamed field fails at the border.
#[derive(FromPyObject)]
struct Settings {
    tile_size: u32,
    eps2d: f64,
    near_plane: f64,
    far_plane: f64,
    radius_clip: f64,
    alpha_threshold: f64,
    max_alpha: f64,
    min_transmittance: f64,
    exp_degree: u32,
    antialiased: bool,
}

impl From<Settings> for RasterSettings {
    fn from(s: Settings) -> Self {
        Self {
            tile_size: s.tile_size,
            eps2d: s.eps2d,
            near_plane: s.near_plane,
            far_plane: s.far_plane,
            radius_clip: s.radius_clip,
            alpha_threshold: s.alpha_threshold,
            max_alpha: s.max_alpha,
            min_transmittance: s.min_transmittance,
            exp_degree: s.exp_degree,
            antialiased: s.antialiased,
        }
    }
}

fn value_error(error: RasterError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

fn mode_named(name: &str) -> PyResult<RenderMode> {
    RenderMode::from_name(name).ok_or_else(|| {
        PyValueError::new_err(format!(
            "render_mode: expected one of RGB, D, ED, RGB+D, RGB+ED, found '{name}'"
        ))
    })
}

fn camera_model_named(name: &str) -> PyResult<CameraModel> {
    CameraModel::from_name(name).ok_or_else(|| {
        PyValueError::new_err(format!(
            "camera_model: expected one of pinhole, ortho, found '{name}'"
        ))
    })
}

/// Runs the engine; see [`call::run`].
fn run<R: Send>(py: Python<'_>, work: impl FnOnce() -> Result<R, RasterError> + Send) -> PyResult<R> {
    call::run(py, "the rasteriser", value_error, work)
}

fn forward<'py, T: Kind>(
    py: Python<'py>,
    arrays: &Arrays<'py, T>,
    lead: &[usize],
    (width, height): (usize, usize),
    settings: &RasterSettings,
    (mode, camera_model): (RenderMode, CameraModel),
) -> PyResult<Bound<'py, PyTuple>> {
    let (shape, inputs) = arrays.inputs((width, height), camera_model)?;
    let (images, state) = run(py, || Batch::new(shape, inputs, settings, mode)?.render())?;
    let n = shape.gaussians;
    (
        array(
            py,
            images.colors,
            lead,
            &[height, width, shape.image_channels(mode)],
        )?,
        array(py, images.alphas, lead, &[height, width, 1])?,
        array(py, images.means2d.into_flattened(), lead, &[n, 2])?,
        array(py, images.depths, lead, &[n])?,
        array(py, images.radii.into_flattened(), lead, &[n, 2])?,
        RasterState { kept: T::keep(state) },
    )
        .into_pyobject(py)
}

/// Renders a batch.
///
/// Every array is C-contiguous, float32 or float64 throughout; `counts` says of each how many batch entries and cameras
/// (or 1: shared) its leading axes stand for. Images have the leading axes `lead`.
///
/// means `[.., N, 3]`, quats `[.., N, 4]`, scales `[.., N, 3]`, opacities `[.., N]`, colors `[.., N, D]`,
/// viewmats `[.., 4, 4]`, Ks `[.., 3, 3]`, backgrounds `[.., D]` or None, pixel_mask `[.., H, W]` or None.
///
/// Returns (colors, alphas, means2d, depths, radii, state). Raises ValueError.
#[pyfunction]
fn rasterize_forward<'py>(
    py: Python<'py>,
    arrays: &Bound<'py, PyTuple>,
    counts: [Count; 9],
    lead: Vec<usize>,
    width: usize,
    height: usize,
    settings: Settings,
    render_mode: &str,
    camera_model: &str,
) -> PyResult<Bound<'py, PyTuple>> {
    let (settings, size) = (settings.into(), (width, height));
    let mode = (mode_named(render_mode)?, camera_model_named(camera_model)?);
    if is_single(arrays) {
        let arrays = Arrays::<f32>::extract(arrays, counts)?;
        forward(py, &arrays, &lead, size, &settings, mode)
    } else {
        let arrays = Arrays::<f64>::extract(arrays, counts)?;
        forward(py, &arrays, &lead, size, &settings, mode)
    }
}

fn backward<'py, T: Kind>(
    py: Python<'py>,
    state: &BatchState<T>,
    arrays: &Gaussians<'py, T>,
    [v_colors, v_alphas]: [Option<&Bound<'py, PyAny>>; 2],
    wanted: Wanted,
) -> PyResult<Bound<'py, PyTuple>> {
    let gaussians = arrays.broadcast()?;
    let v_colors = v_colors.map(|v| slice::<T>("v_colors", v)).transpose()?;
    let v_alphas = v_alphas.map(|v| slice::<T>("v_alphas", v)).transpose()?;
    let v_colors = v_colors.as_ref().map(|v| contiguous("v_colors", v)).transpose()?;
    let v_alphas = v_alphas.as_ref().map(|v| contiguous("v_alphas", v)).transpose()?;
    let gradients = run(py, || {
        state.vjp_of_rendered(&gaussians, v_colors, v_alphas, wanted)
    })?;
    (
        gradient(py, gradients.means),
        gradient(py, gradients.quats),
        gradient(py, gradients.scales),
        gradient(py, gradients.opacities),
        gradient(py, gradients.colors),
        gradient(py, gradients.viewmats),
        gradient(py, gradients.backgrounds),
        gradient(py, gradients.means2d),
        gradient(py, gradients.absgrad),
        gradients.tiles_skipped,
    )
        .into_pyobject(py)
}

/// Gradients of means, quats, scales, opacities, colors, viewmats (three rows of four) and backgrounds, flat, in the
/// layout of their input, of means2d `[views, N, 2]`, its absolute form, and the number of tiles without incoming
/// gradient. `wanted` has
/// one flag per array; what is not wanted is an empty one. Where means2d is wanted, what passes through it is left out
/// of means and viewmats. Gradients of the images may be None for zeros. `arrays` are means, quats, scales, opacities and
/// colors of the forward call that made `state`, which knows the rest. Raises ValueError.
#[pyfunction]
fn rasterize_backward<'py>(
    py: Python<'py>,
    state: &Bound<'py, RasterState>,
    arrays: &Bound<'py, PyTuple>,
    counts: [Count; 5],
    v_colors: Option<&Bound<'py, PyAny>>,
    v_alphas: Option<&Bound<'py, PyAny>>,
    wanted: [bool; 9],
) -> PyResult<Bound<'py, PyTuple>> {
    let [
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmats,
        backgrounds,
        means2d,
        absgrad,
    ] = wanted;
    let wanted = Wanted {
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmats,
        backgrounds,
        means2d,
        detach_means2d: means2d,
        absgrad,
    };
    let (v, kept) = ([v_colors, v_alphas], &state.get().kept);
    if let Some(state) = f32::kept(kept) {
        backward(py, state, &Gaussians::extract(arrays, counts)?, v, wanted)
    } else if let Some(state) = f64::kept(kept) {
        backward(py, state, &Gaussians::extract(arrays, counts)?, v, wanted)
    } else {
        Err(PyTypeError::new_err(
            "state: expected one made by rasterize_forward",
        ))
    }
}

#[pymethods]
impl RasterState {
    /// For every pixel the Gaussian at which half its light is gone, or −1: `[*lead, height, width]`.
    fn median_ids<'py>(
        &self,
        py: Python<'py>,
        lead: Vec<usize>,
        width: usize,
        height: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let ids = run(py, || {
            Ok(match &self.kept {
                Kept::Single(state) => state.median_ids(),
                Kept::Double(state) => state.median_ids(),
            })
        })?;
        array(py, ids, &lead, &[height, width])
    }

    /// Work done and skipped in the forward pass, summed over the views.
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let counters = match &self.kept {
            Kept::Single(state) => state.counters(),
            Kept::Double(state) => state.counters(),
        };
        let dict = PyDict::new(py);
        dict.set_item("n_isects", counters.intersections)?;
        dict.set_item("n_visible", counters.visible)?;
        dict.set_item("n_culled", counters.culled)?;
        dict.set_item("n_empty_tiles", counters.empty_tiles)?;
        dict.set_item("n_saturated", counters.saturated)?;
        Ok(dict)
    }
}

/// The engine's own defaults, by the names of `bigs.raster.RasterSettings`.
#[pyfunction]
fn default_settings(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let s = RasterSettings::default();
    let dict = PyDict::new(py);
    dict.set_item("tile_size", s.tile_size)?;
    dict.set_item("eps2d", s.eps2d)?;
    dict.set_item("near_plane", s.near_plane)?;
    dict.set_item("far_plane", s.far_plane)?;
    dict.set_item("radius_clip", s.radius_clip)?;
    dict.set_item("alpha_threshold", s.alpha_threshold)?;
    dict.set_item("max_alpha", s.max_alpha)?;
    dict.set_item("min_transmittance", s.min_transmittance)?;
    dict.set_item("exp_degree", s.exp_degree)?;
    dict.set_item("antialiased", s.antialiased)?;
    Ok(dict)
}

#[pymodule]
fn _raster(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", env!("CARGO_PKG_VERSION"))?;
    m.add_class::<RasterState>()?;
    m.add_function(wrap_pyfunction!(rasterize_forward, m)?)?;
    m.add_function(wrap_pyfunction!(rasterize_backward, m)?)?;
    m.add_function(wrap_pyfunction!(default_settings, m)?)?;
    m.add_function(wrap_pyfunction!(measure::simd_level, m)?)?;
    m.add_function(wrap_pyfunction!(sh::harmonics_forward, m)?)?;
    m.add_function(wrap_pyfunction!(sh::harmonics_backward, m)?)?;
    m.add_function(wrap_pyfunction!(pose::pose_forward, m)?)?;
    m.add_function(wrap_pyfunction!(pose::pose_backward, m)?)?;
    m.add_class::<touch::TouchState>()?;
    m.add_function(wrap_pyfunction!(hand_poses::hand_poses_forward, m)?)?;
    m.add_function(wrap_pyfunction!(hand_poses::hand_poses_backward, m)?)?;
    m.add_function(wrap_pyfunction!(poses::rotations_forward, m)?)?;
    m.add_function(wrap_pyfunction!(poses::rotations_backward, m)?)?;
    m.add_function(wrap_pyfunction!(poses::tree_forward, m)?)?;
    m.add_function(wrap_pyfunction!(poses::tree_backward, m)?)?;
    m.add_function(wrap_pyfunction!(fingers::finger_costs_forward, m)?)?;
    m.add_function(wrap_pyfunction!(fingers::finger_costs_backward, m)?)?;
    m.add_function(wrap_pyfunction!(occlusion::form_factors, m)?)?;
    m.add_class::<outline::OutlineState>()?;
    m.add_function(wrap_pyfunction!(outline::outline_forward, m)?)?;
    m.add_function(wrap_pyfunction!(outline::outline_backward, m)?)?;
    m.add_function(wrap_pyfunction!(touch::distances, m)?)?;
    m.add_function(wrap_pyfunction!(touch::touch_forward, m)?)?;
    m.add_function(wrap_pyfunction!(touch::touch_backward, m)?)?;
    m.add_function(wrap_pyfunction!(pixels::terms_together, m)?)?;
    m.add_function(wrap_pyfunction!(pixels::terms_together_backward, m)?)?;
    m.add_function(wrap_pyfunction!(pixels::coverage_squares, m)?)?;
    m.add_function(wrap_pyfunction!(pixels::coverage_squares_backward, m)?)?;
    m.add_function(wrap_pyfunction!(pixels::terms_alone, m)?)?;
    m.add_function(wrap_pyfunction!(pixels::terms_alone_backward, m)?)?;
    m.add_function(wrap_pyfunction!(track::cut_patches, m)?)?;
    m.add_function(wrap_pyfunction!(track::lay_patches, m)?)?;
    m.add_class::<bundle::BundleSightings>()?;
    m.add_class::<shape::SymmetryJudge>()?;
    m.add_class::<shape::NearestPoints>()?;
    m.add_function(wrap_pyfunction!(shape::cone_distances, m)?)?;
    m.add_function(wrap_pyfunction!(shape::times_seen, m)?)?;
    m.add_function(wrap_pyfunction!(shape::times_empty, m)?)?;
    m.add_function(wrap_pyfunction!(shape::beyond_planes, m)?)?;
    m.add_function(wrap_pyfunction!(shape::border_distances, m)?)?;
    m.add_function(wrap_pyfunction!(measure::fma_peak_gflops, m)?)?;
    m.add_function(wrap_pyfunction!(measure::time_engine, m)?)
}

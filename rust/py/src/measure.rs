//! What a benchmark asks of the engine without numpy or torch in between.

use std::hint::black_box;
use std::time::Instant;

use bigs_raster::stages::Stages;
use bigs_raster::{Camera, Gaussians, Intrinsics, RasterError, RenderMode, Renderer};
use numpy::PyReadonlyArrayDyn;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::convert::{contiguous, rows};
use crate::{Settings, run, value_error};

/// The CPU feature level the kernels run at: avx512, avx2, neon or baseline. Raises ValueError for an unknown
/// `BIGS_RASTER_SIMD`.
#[pyfunction]
pub(crate) fn simd_level() -> PyResult<&'static str> {
    bigs_raster::peak::simd_level().map_err(value_error)
}

/// Measured peak of one thread in 10⁹ float32 operations per second at that level; a multiply-add is two.
#[pyfunction]
pub(crate) fn fma_peak_gflops(py: Python<'_>) -> PyResult<f64> {
    py.detach(bigs_raster::peak::fma_peak_gflops).map_err(value_error)
}

type Array<'py> = PyReadonlyArrayDyn<'py, f32>;

/// Wall seconds of one pass: the stages project, bin and composite with their vjps, then the whole calls forward and
/// backward.
///
/// means `[N, 3]`, quats `[N, 4]`, scales `[N, 3]`, opacities `[N]`, colors `[N, 3]`, viewmat `[4, 4]`, K `[3, 3]`,
/// v_colors `[H, W, 3]`: float32, C-contiguous. Raises ValueError.
#[pyfunction]
pub(crate) fn time_engine<'py>(
    py: Python<'py>,
    gaussians: [Array<'py>; 5],
    camera: [Array<'py>; 2],
    width: usize,
    height: usize,
    settings: Settings,
    v_colors: Array<'py>,
) -> PyResult<Vec<(&'static str, f64)>> {
    let [means, quats, scales, opacities, colors] = &gaussians;
    let gaussians = Gaussians::new(
        rows("means", means)?,
        rows("quats", quats)?,
        rows("scales", scales)?,
        contiguous("opacities", opacities)?,
        contiguous("colors", colors)?,
        3,
    )
    .map_err(value_error)?;
    let [viewmat, k] = &camera;
    let (viewmat, k) = (rows::<f32, 4>("viewmat", viewmat)?, rows::<f32, 3>("K", k)?);
    let (&[row0, row1, row2, row3], &[[fx, _, cx], [_, fy, cy], _]) = (viewmat, k) else {
        return Err(PyValueError::new_err(
            "camera: expected viewmat [4, 4] and K [3, 3]",
        ));
    };
    let intrinsics = Intrinsics { fx, fy, cx, cy };
    let camera = Camera::new([row0, row1, row2, row3], intrinsics, width, height).map_err(value_error)?;
    let v_colors = contiguous("v_colors", &v_colors)?;
    run(py, || timed(&gaussians, &camera, &settings.into(), v_colors))
}

fn timed(
    gaussians: &Gaussians<'_, f32>,
    camera: &Camera<f32>,
    settings: &bigs_raster::RasterSettings,
    v_colors: &[f32],
) -> Result<Vec<(&'static str, f64)>, RasterError> {
    let mut clock = Instant::now();
    let mut lap = || {
        let seconds = clock.elapsed().as_secs_f64();
        clock = Instant::now();
        seconds
    };
    let mut stages = Stages::new(gaussians, camera, settings, RenderMode::Rgb)?;
    lap();
    stages.project();
    let project = lap();
    stages.bin()?;
    let bin = lap();
    black_box(stages.composite());
    let composite = lap();
    let v_alphas = vec![0.0; camera.width() * camera.height()];
    lap();
    stages.composite_vjp(v_colors, &v_alphas)?;
    let composite_vjp = lap();
    black_box(stages.project_vjp()?);
    let project_vjp = lap();
    drop(stages);

    let renderer = Renderer::new(settings, RenderMode::Rgb)?;
    lap();
    let frame = renderer.render(gaussians, camera, None)?;
    let forward = lap();
    black_box(frame.vjp(gaussians, v_colors, &v_alphas)?);
    let backward = lap();
    Ok(vec![
        ("project", project),
        ("bin", bin),
        ("composite", composite),
        ("composite vjp", composite_vjp),
        ("project vjp", project_vjp),
        ("forward", forward),
        ("backward", backward),
    ])
}

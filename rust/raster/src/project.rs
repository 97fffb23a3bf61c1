//! World-space Gaussians to screen-space splats (EWA), and back for gradients.

use rayon::prelude::*;

use crate::camera::{Camera, CameraModel};
use crate::cov::{
    Mat3, Vec3, Whitening, apply, apply_transposed, dot, normalize_quat, rotation_of, rotation_vjp, whiten,
    whiten_vjp,
};
use crate::gaussians::Gaussians;
use crate::real::Real;
use crate::settings::Limits;

/// The slope used in the Jacobian is limited to the image border plus this part of half the image (gsplat's 1.3 rule):
/// far outside the view the linearisation would blow a Gaussian up across the whole image.
const FRUSTUM_MARGIN: f64 = 0.3 * 0.5;

/// Gaussians handled by one task. Fixed, so that sums over chunks do not depend on the number of threads.
const CHUNK: usize = 512;

/// A Gaussian on the screen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Splat<T> {
    pub(crate) x: T,
    pub(crate) y: T,
    pub(crate) w11: T,
    pub(crate) w12: T,
    pub(crate) w22: T,
    /// Opacity after compensation.
    pub(crate) opacity: T,
    /// Alpha reaches the threshold where u² + v² ≤ `reach`.
    pub(crate) reach: T,
    /// Camera z.
    pub(crate) depth: T,
}

/// The splats a camera sees, in the order of the Gaussians.
#[derive(Debug)]
pub(crate) struct Projected<T> {
    pub(crate) ids: Vec<u32>,
    pub(crate) splats: Vec<Splat<T>>,
}

/// What is told about every Gaussian, visible or not (zeros).
pub(crate) struct ScreenInfo<'a, T> {
    pub(crate) means2d: &'a mut [[T; 2]],
    pub(crate) depths: &'a mut [T],
    pub(crate) radii: &'a mut [[i32; 2]],
}

/// A Gaussian in front of a camera, halfway to the screen: everything both passes need.
struct Footprint<T> {
    point: Vec3<T>,
    unit_quat: [T; 4],
    inverse_quat_length: T,
    /// Rotation of the Gaussian.
    axes: Mat3<T>,
    /// Camera rotation · axes · diag(scales).
    shape: Mat3<T>,
    /// Pixels per unit of length at the centre.
    gains: [T; 2],
    /// x/z and y/z after the limit, and whether each is free (within it). Without perspective zero, and held.
    slopes: [T; 2],
    free: [bool; 2],
    /// Rows of A = J · shape.
    rows: [Vec3<T>; 2],
}

#[inline(always)]
fn to_camera<T: Real>(camera: &Camera<T>, mean: Vec3<T>) -> Vec3<T> {
    let rotated = apply(&camera.rotation, mean);
    [0, 1, 2].map(|i| rotated[i] + camera.translation[i])
}

/// Where the camera shows the centre, in pixels.
#[inline(always)]
fn centre<T: Real>(camera: &Camera<T>, point: Vec3<T>) -> [T; 2] {
    let k = &camera.k;
    match camera.model {
        CameraModel::Pinhole => [
            k.fx * (point[0] / point[2]) + k.cx,
            k.fy * (point[1] / point[2]) + k.cy,
        ],
        CameraModel::Orthographic => [k.fx * point[0] + k.cx, k.fy * point[1] + k.cy],
    }
}

#[inline(always)]
fn footprint<T: Real>(camera: &Camera<T>, point: Vec3<T>, quat: [T; 4], scale: Vec3<T>) -> Footprint<T> {
    let (unit_quat, inverse_quat_length) = normalize_quat(quat);
    let axes = rotation_of(unit_quat);
    let scaled = axes.map(|row| [row[0] * scale[0], row[1] * scale[1], row[2] * scale[2]]);
    let shape = camera
        .rotation
        .map(|row| [0, 1, 2].map(|j| row[0] * scaled[0][j] + row[1] * scaled[1][j] + row[2] * scaled[2][j]));

    let k = &camera.k;
    let ([gx, gy], [(sx, free_x), (sy, free_y)]) = match camera.model {
        CameraModel::Pinhole => {
            let inverse_z = T::ONE / point[2];
            let margin = T::of(FRUSTUM_MARGIN);
            let limit_slope = |p: T, f: T, c: T, size: usize| {
                let size = T::of(size as f64);
                let slope = p * inverse_z;
                let limited = slope.limit(-(c + margin * size) / f, (size - c + margin * size) / f);
                (limited, limited == slope)
            };
            (
                [k.fx * inverse_z, k.fy * inverse_z],
                [
                    limit_slope(point[0], k.fx, k.cx, camera.width),
                    limit_slope(point[1], k.fy, k.cy, camera.height),
                ],
            )
        }
        CameraModel::Orthographic => ([k.fx, k.fy], [(T::ZERO, false); 2]),
    };
    let rows = [
        [0, 1, 2].map(|j| gx * (shape[0][j] - sx * shape[2][j])),
        [0, 1, 2].map(|j| gy * (shape[1][j] - sy * shape[2][j])),
    ];
    Footprint {
        point,
        unit_quat,
        inverse_quat_length,
        axes,
        shape,
        gains: [gx, gy],
        slopes: [sx, sy],
        free: [free_x, free_y],
        rows,
    }
}

/// The splat of one Gaussian and its radii on screen; `None` if no pixel can see it.
#[inline(always)]
fn splat<T: Real>(
    camera: &Camera<T>,
    limits: &Limits<T>,
    mean: Vec3<T>,
    quat: [T; 4],
    scale: Vec3<T>,
    opacity: T,
) -> Option<(Splat<T>, [T; 2])> {
    let point = to_camera(camera, mean);
    let depth = point[2];
    // Written so that NaN, which finite inputs can still overflow to, is culled too.
    if !(depth > limits.near && depth < limits.far) {
        return None;
    }
    let [x, y] = centre(camera, point);
    let shape = footprint(camera, point, quat, scale);
    let w = whiten(shape.rows[0], shape.rows[1], limits.eps2d)?;
    let opacity = if limits.antialiased {
        opacity * w.compensation
    } else {
        opacity
    };
    if !(opacity >= limits.alpha_threshold) {
        return None;
    }
    let reach = if limits.alpha_threshold > T::ZERO {
        (opacity / limits.alpha_threshold).log2()
    } else {
        T::of(f64::INFINITY)
    };
    let two_ln_2 = T::of(2.0 * std::f64::consts::LN_2);
    let radius = w
        .deviations
        .map(|deviation| (two_ln_2 * reach).sqrt() * deviation);
    let (width, height) = (T::of(camera.width as f64), T::of(camera.height as f64));
    let on_screen =
        x + radius[0] > T::ZERO && x - radius[0] < width && y + radius[1] > T::ZERO && y - radius[1] < height;
    let clipped = radius[0] <= limits.radius_clip && radius[1] <= limits.radius_clip;
    // Radius 0 is a Gaussian that reaches the threshold only at its very centre.
    if !on_screen || (clipped && limits.radius_clip > T::ZERO) || !(x.is_finite() && y.is_finite()) {
        return None;
    }
    let splat = Splat {
        x,
        y,
        w11: w.w11,
        w12: w.w12,
        w22: w.w22,
        opacity,
        reach,
        depth,
    };
    Some((splat, radius))
}

/// Projects every Gaussian of a view.
pub(crate) fn project<T: Real>(
    gaussians: &Gaussians<'_, T>,
    camera: &Camera<T>,
    limits: &Limits<T>,
    info: ScreenInfo<'_, T>,
) -> Projected<T> {
    let chunks: Vec<(Vec<u32>, Vec<Splat<T>>)> = (
        info.means2d.par_chunks_mut(CHUNK),
        info.depths.par_chunks_mut(CHUNK),
        info.radii.par_chunks_mut(CHUNK),
    )
        .into_par_iter()
        .enumerate()
        .map(|(chunk, (means2d, depths, radii))| {
            let first = chunk * CHUNK;
            let mut ids = Vec::with_capacity(depths.len());
            let mut splats = Vec::with_capacity(depths.len());
            for local in 0..depths.len() {
                let i = first + local;
                let Some((splat, radius)) = splat(
                    camera,
                    limits,
                    gaussians.means[i],
                    gaussians.quats[i],
                    gaussians.scales[i],
                    gaussians.opacities[i],
                ) else {
                    continue;
                };
                means2d[local] = [splat.x, splat.y];
                depths[local] = splat.depth;
                // The cast saturates, so an unbounded Gaussian gets the largest integer.
                radii[local] = radius.map(|r| r.as_f64().ceil() as i32);
                ids.push(i as u32);
                splats.push(splat);
            }
            (ids, splats)
        })
        .collect();
    let visible = chunks.iter().map(|(ids, _)| ids.len()).sum();
    let mut projected = Projected {
        ids: Vec::with_capacity(visible),
        splats: Vec::with_capacity(visible),
    };
    for (ids, splats) in chunks {
        projected.ids.extend(ids);
        projected.splats.extend(splats);
    }
    projected
}

/// Gradients of a splat as the compositor sums them: over pixels, h = ∂loss/∂alpha · 2^−(u² + v²).
#[derive(Clone, Copy, Debug)]
pub(crate) struct SplatGradient<T> {
    /// Σ h
    pub(crate) h: T,
    /// Σ h u, Σ h v
    pub(crate) first: [T; 2],
    /// Σ h u², Σ h u v, Σ h v²
    pub(crate) second: [T; 3],
    /// Gradient of camera z as a channel.
    pub(crate) depth: T,
}

/// Gradients of one view for one Gaussian; the last is that of the world-to-camera matrix, rows of [R | t].
pub(crate) struct GaussianGradient<T> {
    pub(crate) mean: Vec3<T>,
    pub(crate) quat: [T; 4],
    pub(crate) scale: Vec3<T>,
    pub(crate) opacity: T,
    pub(crate) viewmat: [[T; 4]; 3],
}

/// The vjp of [`splat`]; zero for a Gaussian that has none.
#[inline(always)]
pub(crate) fn project_vjp<T: Real>(
    gaussians: &Gaussians<'_, T>,
    camera: &Camera<T>,
    limits: &Limits<T>,
    i: usize,
    v: &SplatGradient<T>,
) -> Option<GaussianGradient<T>> {
    let (mean, scale, opacity) = (gaussians.means[i], gaussians.scales[i], gaussians.opacities[i]);
    let shape = footprint(camera, to_camera(camera, mean), gaussians.quats[i], scale);
    let w: Whitening<T> = whiten(shape.rows[0], shape.rows[1], limits.eps2d)?;
    let (compensation, v_compensation) = if limits.antialiased {
        (w.compensation, v.h * opacity)
    } else {
        (T::ONE, T::ZERO)
    };

    // alpha = opacity · 2^e, so the gradient of e is ln 2 · opacity · h; e = −(u² + v²).
    let ln_2 = T::of(std::f64::consts::LN_2);
    let gain = ln_2 * opacity * compensation;
    let two = T::ONE + T::ONE;
    let v_x = two * gain * w.w11 * v.first[0];
    let v_y = two * gain * (w.w12 * v.first[0] + w.w22 * v.first[1]);
    let moments = v.second.map(|m| gain * m);
    let (v_r0, v_r1) = whiten_vjp(
        shape.rows[0],
        shape.rows[1],
        limits.eps2d,
        &w,
        moments,
        v_compensation,
    );

    let [gx, gy] = shape.gains;
    let [sx, sy] = shape.slopes;
    // rows = gain (shape₀₁ − slope · shape₂)
    let v_shape = [
        v_r0.map(|g| gx * g),
        v_r1.map(|g| gy * g),
        [0, 1, 2].map(|j| -(gx * sx * v_r0[j] + gy * sy * v_r1[j])),
    ];
    let k = &camera.k;
    let v_point = match camera.model {
        CameraModel::Pinhole => {
            let inverse_z = T::ONE / shape.point[2];
            let mut v_z = v.depth - inverse_z * (dot(shape.rows[0], v_r0) + dot(shape.rows[1], v_r1));
            // Slopes: of the centre on screen always, of the Jacobian where the limit does not hold.
            let mut v_sx = k.fx * v_x;
            let mut v_sy = k.fy * v_y;
            let (slope_x, slope_y) = (shape.point[0] * inverse_z, shape.point[1] * inverse_z);
            if shape.free[0] {
                v_sx += -gx * dot(shape.shape[2], v_r0);
            }
            if shape.free[1] {
                v_sy += -gy * dot(shape.shape[2], v_r1);
            }
            v_z += -(v_sx * slope_x + v_sy * slope_y) * inverse_z;
            [v_sx * inverse_z, v_sy * inverse_z, v_z]
        }
        CameraModel::Orthographic => [k.fx * v_x, k.fy * v_y, v.depth],
    };

    // shape = R · axes · diag(scale)
    let columns =
        [0, 1, 2].map(|j| apply_transposed(&camera.rotation, [v_shape[0][j], v_shape[1][j], v_shape[2][j]]));
    let v_scale = [0, 1, 2].map(|j| dot(columns[j], [shape.axes[0][j], shape.axes[1][j], shape.axes[2][j]]));
    let v_axes = [0, 1, 2].map(|i| [0, 1, 2].map(|j| columns[j][i] * scale[j]));
    let v_rotation = [0, 1, 2].map(|r| {
        [0, 1, 2].map(|c| {
            v_point[r] * mean[c]
                + (v_shape[r][0] * shape.axes[c][0] * scale[0]
                    + v_shape[r][1] * shape.axes[c][1] * scale[1]
                    + v_shape[r][2] * shape.axes[c][2] * scale[2])
        })
    });
    Some(GaussianGradient {
        mean: apply_transposed(&camera.rotation, v_point),
        quat: rotation_vjp(shape.unit_quat, shape.inverse_quat_length, &v_axes),
        scale: v_scale,
        opacity: v.h * compensation,
        viewmat: [0, 1, 2].map(|r| [v_rotation[r][0], v_rotation[r][1], v_rotation[r][2], v_point[r]]),
    })
}

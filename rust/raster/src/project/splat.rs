//! One Gaussian to one splat on the screen (EWA), and back for gradients.
//!
//! Everything here is free of branches that depend on the Gaussian, so that `packet` can run it on many at once.

use crate::input::camera::{Camera, CameraModel};
use crate::input::channels::FIRST;
use crate::input::settings::Limits;
use crate::math::covariance::{
    Mat3, Vec3, apply, apply_transposed, dot, normalize_quat, rotation_of, rotation_vjp, three, whiten,
    whiten_vjp,
};
use crate::math::real::Real;

/// The slope used in the Jacobian is limited to the image border plus this part of half the image (gsplat's 1.3 rule):
/// far outside the view the linearisation would blow a Gaussian up across the whole image.
const FRUSTUM_MARGIN: f64 = 0.3 * 0.5;

/// A centre this many standard deviations from the image's corner is dropped, because squares of such distances overflow
/// `f32`.
const UNREACHABLE: f64 = 1e30;

/// The least opacity that is composited: smaller ones are raised to it, because 0 has no logarithm. Neither scalar can
/// show the difference in an image. Only reached without an alpha threshold.
const FAINTEST: f64 = 1.0 / (1u64 << 63) as f64;

/// A Gaussian on the screen: all that tiles read of it, one cache line in `f32`.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(crate) struct Splat<T> {
    pub(crate) x: T,
    pub(crate) y: T,
    pub(crate) w11: T,
    pub(crate) w22: T,
    /// As in [`crate::math::covariance::Whitening`].
    pub(crate) slope: T,
    /// Of its outline, a little widened: dy of the rightmost point, and half the height.
    pub(crate) right: T,
    pub(crate) half_height: T,
    /// log₂ of the opacity after compensation, or of [`FAINTEST`].
    pub(crate) log_opacity: T,
    /// Of its first channels.
    pub(crate) values: [T; FIRST],
}

impl<T: Real> Splat<T> {
    /// See [`crate::math::covariance::Whitening`]: the very bits of its `w12`.
    #[inline(always)]
    pub(crate) fn w12(&self) -> T {
        -self.w11 * self.slope
    }
}

/// What the caller learns about every Gaussian; zeros for those that no pixel sees.
#[derive(Debug)]
pub(crate) struct ScreenInfo<'a, T> {
    pub(crate) means2d: &'a mut [[T; 2]],
    pub(crate) depths: &'a mut [T],
    pub(crate) radii: &'a mut [[i32; 2]],
}

/// How a view projects: its camera, its settings and what follows from both.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Projection<T> {
    camera: Camera<T>,
    limits: Limits<T>,
    perspective: bool,
    /// Least and greatest slope for the Jacobian, along x and y.
    slopes: [(T, T); 2],
    size: [T; 2],
    log_threshold: T,
}

impl<T: Real> Projection<T> {
    pub(crate) fn new(camera: &Camera<T>, limits: &Limits<T>) -> Self {
        let k = &camera.k;
        let size = [T::of(camera.width as f64), T::of(camera.height as f64)];
        let margin = T::of(FRUSTUM_MARGIN);
        let slopes = |f: T, c: T, size: T| (-(c + margin * size) / f, (size - c + margin * size) / f);
        Self {
            camera: *camera,
            limits: *limits,
            perspective: camera.model == CameraModel::Pinhole,
            slopes: [slopes(k.fx, k.cx, size[0]), slopes(k.fy, k.cy, size[1])],
            size,
            log_threshold: log_threshold(limits),
        }
    }

    pub(crate) fn antialiased(&self) -> bool {
        self.limits.antialiased
    }
}

/// log₂ of the alpha threshold, −∞ without one: a splat reaches as far as log₂ of its opacity exceeds it.
pub(crate) fn log_threshold<T: Real>(limits: &Limits<T>) -> T {
    if limits.alpha_threshold > T::ZERO {
        // Rounded once: it decides which pairs count.
        T::of(limits.alpha_threshold.greater(T::TINY).as_f64().log2())
    } else {
        T::of(f64::NEG_INFINITY)
    }
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
    /// What perspective divides by: camera z, or 1 without it. And its reciprocal.
    z: T,
    inverse_z: T,
    /// Pixels per unit of length at the centre.
    gains: [T; 2],
    /// x/z and y/z after the limit, and whether each is free (within it). Without perspective zero, and held.
    slopes: [T; 2],
    free: [bool; 2],
    /// Rows of A = J · shape.
    rows: [Vec3<T>; 2],
}

#[inline(always)]
fn footprint<T: Real>(
    projection: &Projection<T>,
    mean: Vec3<T>,
    quat: [T; 4],
    scale: Vec3<T>,
) -> Footprint<T> {
    let camera = &projection.camera;
    let rotated = apply(&camera.rotation, mean);
    let point = three(|i| rotated[i] + camera.translation[i]);
    let (unit_quat, inverse_quat_length) = normalize_quat(quat);
    let axes = rotation_of(unit_quat);
    let scaled = three(|i| three(|j| axes[i][j] * scale[j]));
    let r = &camera.rotation;
    let shape =
        three(|i| three(|j| r[i][0] * scaled[0][j] + r[i][1] * scaled[1][j] + r[i][2] * scaled[2][j]));

    let k = &camera.k;
    let z = if projection.perspective { point[2] } else { T::ONE };
    let inverse_z = T::ONE / z;
    let limit_slope = |p: T, (least, greatest): (T, T)| {
        let slope = p * inverse_z;
        let limited = slope.limit(least, greatest);
        (
            if projection.perspective { limited } else { T::ZERO },
            projection.perspective & (limited == slope),
        )
    };
    let (sx, free_x) = limit_slope(point[0], projection.slopes[0]);
    let (sy, free_y) = limit_slope(point[1], projection.slopes[1]);
    let (gx, gy) = (k.fx * inverse_z, k.fy * inverse_z);
    Footprint {
        point,
        unit_quat,
        inverse_quat_length,
        axes,
        shape,
        z,
        inverse_z,
        gains: [gx, gy],
        slopes: [sx, sy],
        free: [free_x, free_y],
        rows: [
            three(|j| gx * (shape[0][j] - sx * shape[2][j])),
            three(|j| gy * (shape[1][j] - sy * shape[2][j])),
        ],
    }
}

/// A splat on its way, and its outline: the ellipse {u² + v² ≤ reach}, where alpha reaches the threshold.
pub(crate) struct Outlined<T> {
    pub(crate) x: T,
    pub(crate) y: T,
    pub(crate) w11: T,
    pub(crate) w22: T,
    pub(crate) slope: T,
    pub(crate) tilt: T,
    pub(crate) log_opacity: T,
    /// Camera z.
    pub(crate) depth: T,
    pub(crate) reach: T,
    /// Half the extent along x and y, in px.
    pub(crate) radii: [T; 2],
    /// Standard deviations along x and y, in px.
    pub(crate) deviations: [T; 2],
    /// Whether some pixel may see it; if not, the other fields are of no meaning.
    pub(crate) visible: bool,
}

/// How far an ellipse of this reach extends, per standard deviation.
#[inline(always)]
pub(crate) fn extent<T: Real>(reach: T) -> T {
    (T::of(2.0 * std::f64::consts::LN_2) * reach).sqrt()
}

/// Where one Gaussian is on the screen.
#[inline(always)]
pub(crate) fn splat<T: Real, const ANTIALIASED: bool>(
    projection: &Projection<T>,
    mean: Vec3<T>,
    quat: [T; 4],
    scale: Vec3<T>,
    opacity: T,
) -> Outlined<T> {
    let (k, limits) = (&projection.camera.k, &projection.limits);
    let shape = footprint(projection, mean, quat, scale);
    let depth = shape.point[2];
    // A division rounds once, a product with the reciprocal twice, and a pixel position needs every bit.
    let x = k.fx * (shape.point[0] / shape.z) + k.cx;
    let y = k.fy * (shape.point[1] / shape.z) + k.cy;
    let w = whiten(shape.rows[0], shape.rows[1], limits.eps2d);
    let opacity = if ANTIALIASED {
        opacity * w.compensation
    } else {
        opacity
    };
    let log_opacity = opacity.greater(T::of(FAINTEST)).log2();
    let reach = log_opacity - projection.log_threshold;
    let extent = extent(reach);
    let (rx, ry) = (extent * w.deviations[0], extent * w.deviations[1]);
    // Finite inputs can overflow to NaN here; these comparisons are false for it, so that it is culled.
    // The distance matters without an alpha threshold only, when nothing else limits how far a Gaussian reaches.
    let distance = (w.w11 * x).abs() + (w.w12 * y).abs() + (w.w22 * y).abs();
    let in_range = (depth > limits.near) & (depth < limits.far) & w.sound & (distance < T::of(UNREACHABLE));
    let [width, height] = projection.size;
    let on_screen = (x + rx > T::ZERO) & (x - rx < width) & (y + ry > T::ZERO) & (y - ry < height);
    // Radius 0 is a Gaussian that reaches the threshold only at its very centre.
    let clipped = (rx <= limits.radius_clip) & (ry <= limits.radius_clip) & (limits.radius_clip > T::ZERO);
    Outlined {
        x,
        y,
        w11: w.w11,
        w22: w.w22,
        slope: w.slope,
        tilt: w.tilt,
        log_opacity,
        depth,
        reach,
        radii: [rx, ry],
        deviations: w.deviations,
        visible: in_range & on_screen & !clipped & (opacity >= limits.alpha_threshold),
    }
}

/// Gradients of a splat as the compositor sums them: over pixels, h = ∂loss/∂alpha · alpha, where alpha is not limited.
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

/// The vjp of [`splat`] for a visible Gaussian.
#[inline(always)]
pub(crate) fn splat_vjp<T: Real, const ANTIALIASED: bool>(
    projection: &Projection<T>,
    mean: Vec3<T>,
    quat: [T; 4],
    scale: Vec3<T>,
    opacity: T,
    v: &SplatGradient<T>,
) -> GaussianGradient<T> {
    let (camera, eps) = (&projection.camera, projection.limits.eps2d);
    let shape = footprint(projection, mean, quat, scale);
    let w = whiten(shape.rows[0], shape.rows[1], eps);
    let compensation = if ANTIALIASED { w.compensation } else { T::ONE };

    // alpha = opacity · 2^e, so the gradient of e is ln 2 · h; e = −(u² + v²).
    let gain = T::of(std::f64::consts::LN_2);
    let v_opacity = v.h / (opacity * compensation).greater(T::of(FAINTEST));
    let two = T::ONE + T::ONE;
    let v_x = two * gain * w.w11 * v.first[0];
    let v_y = two * gain * (w.w12 * v.first[0] + w.w22 * v.first[1]);
    let v_compensation = if ANTIALIASED {
        Some(v_opacity * opacity)
    } else {
        None
    };
    let moments = three(|m| gain * v.second[m]);
    let (v_r0, v_r1) = whiten_vjp(shape.rows[0], shape.rows[1], eps, &w, moments, v_compensation);

    let [gx, gy] = shape.gains;
    let [sx, sy] = shape.slopes;
    // rows = gain (shape₀₁ − slope · shape₂)
    let v_shape = [
        three(|j| gx * v_r0[j]),
        three(|j| gy * v_r1[j]),
        three(|j| -(gx * sx * v_r0[j] + gy * sy * v_r1[j])),
    ];
    // Slopes: of the centre on screen always, of the Jacobian where the limit does not hold.
    let held = |free: bool, v: T| if free { v } else { T::ZERO };
    let v_sx = camera.k.fx * v_x - held(shape.free[0], gx * dot(shape.shape[2], v_r0));
    let v_sy = camera.k.fy * v_y - held(shape.free[1], gy * dot(shape.shape[2], v_r1));
    let (slope_x, slope_y) = (shape.point[0] * shape.inverse_z, shape.point[1] * shape.inverse_z);
    let nearer = dot(shape.rows[0], v_r0) + dot(shape.rows[1], v_r1) + v_sx * slope_x + v_sy * slope_y;
    let v_point = [
        v_sx * shape.inverse_z,
        v_sy * shape.inverse_z,
        v.depth - held(projection.perspective, shape.inverse_z * nearer),
    ];

    // shape = R · axes · diag(scale)
    let columns =
        three(|j| apply_transposed(&camera.rotation, [v_shape[0][j], v_shape[1][j], v_shape[2][j]]));
    let v_scale = three(|j| dot(columns[j], [shape.axes[0][j], shape.axes[1][j], shape.axes[2][j]]));
    let v_axes = three(|i| three(|j| columns[j][i] * scale[j]));
    let v_rotation = three(|r| {
        three(|c| {
            v_point[r] * mean[c]
                + (v_shape[r][0] * shape.axes[c][0] * scale[0]
                    + v_shape[r][1] * shape.axes[c][1] * scale[1]
                    + v_shape[r][2] * shape.axes[c][2] * scale[2])
        })
    });
    GaussianGradient {
        mean: apply_transposed(&camera.rotation, v_point),
        quat: rotation_vjp(shape.unit_quat, shape.inverse_quat_length, &v_axes),
        scale: v_scale,
        opacity: v_opacity * compensation,
        viewmat: three(|r| [v_rotation[r][0], v_rotation[r][1], v_rotation[r][2], v_point[r]]),
    }
}

//! Rotation from a quaternion, and the screen covariance as a whitening transform, with the vjp of each.
//!
//! No 2×2 determinant is ever formed as ac − b²: with the rows r₀, r₁ of A (Σ = A Aᵀ + εI),
//! det Σ = |r₀ × r₁|² + ε(|r₀|² + |r₁|²) + ε², a sum of positive terms that loses nothing for needles.

use crate::math::real::Real;

pub(crate) type Vec3<T> = [T; 3];
pub(crate) type Mat3<T> = [[T; 3]; 3];

/// Three values. `array::map` is not always inlined into large functions, and a call keeps a loop from vectorising.
#[inline(always)]
pub(crate) fn three<U>(mut f: impl FnMut(usize) -> U) -> [U; 3] {
    [f(0), f(1), f(2)]
}

#[inline(always)]
pub(crate) fn dot<T: Real>(a: Vec3<T>, b: Vec3<T>) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// The matrix times the vector.
#[inline(always)]
pub(crate) fn apply<T: Real>(m: &Mat3<T>, v: Vec3<T>) -> Vec3<T> {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

/// The transposed matrix times the vector.
#[inline(always)]
pub(crate) fn apply_transposed<T: Real>(m: &Mat3<T>, v: Vec3<T>) -> Vec3<T> {
    three(|j| m[0][j] * v[0] + m[1][j] * v[1] + m[2][j] * v[2])
}

/// A normalised quaternion and the reciprocal of the length it had; (0, 0, 0, 0) for one without direction.
#[inline(always)]
pub(crate) fn normalize_quat<T: Real>(q: [T; 4]) -> ([T; 4], T) {
    // Dividing by the largest entry first keeps the squares in range for every finite input.
    let largest = q[0]
        .abs()
        .greater(q[1].abs())
        .greater(q[2].abs().greater(q[3].abs()));
    let directed = largest >= T::TINY;
    let shrink = T::ONE / largest.greater(T::TINY);
    let r = [q[0] * shrink, q[1] * shrink, q[2] * shrink, q[3] * shrink];
    let length = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3]).sqrt();
    let inverse = if directed { T::ONE / length } else { T::ZERO };
    (
        [r[0] * inverse, r[1] * inverse, r[2] * inverse, r[3] * inverse],
        inverse * shrink,
    )
}

/// Rotation matrix of a unit quaternion (w, x, y, z); the identity for (0, 0, 0, 0).
#[inline(always)]
pub(crate) fn rotation_of<T: Real>([w, x, y, z]: [T; 4]) -> Mat3<T> {
    let two = T::ONE + T::ONE;
    [
        [
            T::ONE - two * (y * y + z * z),
            two * (x * y - w * z),
            two * (x * z + w * y),
        ],
        [
            two * (x * y + w * z),
            T::ONE - two * (x * x + z * z),
            two * (y * z - w * x),
        ],
        [
            two * (x * z - w * y),
            two * (y * z + w * x),
            T::ONE - two * (x * x + y * y),
        ],
    ]
}

/// Gradient with respect to a raw quaternion, given its unit form, the reciprocal of its length and the gradient of
/// the rotation matrix. Tangent to the sphere by construction.
#[inline(always)]
pub(crate) fn rotation_vjp<T: Real>(unit: [T; 4], inverse_length: T, v: &Mat3<T>) -> [T; 4] {
    let [w, x, y, z] = unit;
    let two = T::ONE + T::ONE;
    let v_unit = [
        two * (x * (v[2][1] - v[1][2]) + y * (v[0][2] - v[2][0]) + z * (v[1][0] - v[0][1])),
        two * (y * (v[0][1] + v[1][0]) + z * (v[0][2] + v[2][0]) + w * (v[2][1] - v[1][2])
            - two * x * (v[1][1] + v[2][2])),
        two * (x * (v[0][1] + v[1][0]) + z * (v[1][2] + v[2][1]) + w * (v[0][2] - v[2][0])
            - two * y * (v[0][0] + v[2][2])),
        two * (x * (v[0][2] + v[2][0]) + y * (v[1][2] + v[2][1]) + w * (v[1][0] - v[0][1])
            - two * z * (v[0][0] + v[1][1])),
    ];
    let radial = unit[0] * v_unit[0] + unit[1] * v_unit[1] + unit[2] * v_unit[2] + unit[3] * v_unit[3];
    let tangent = |i: usize| inverse_length * (v_unit[i] - unit[i] * radial);
    [tangent(0), tangent(1), tangent(2), tangent(3)]
}

/// √(½ log₂ e): with it folded into the whitening, exp(−q/2) = 2^−(u² + v²).
const EXP2_SCALE: f64 = 0.849_321_800_288_019_1;

/// The screen covariance Σ = A Aᵀ + εI in the form the compositor uses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Whitening<T> {
    /// (u, v) = (w11 dx + w12 dy, w22 dy) has exp(−½ dᵀΣ⁻¹d) = 2^−(u² + v²).
    pub(crate) w11: T,
    pub(crate) w12: T,
    pub(crate) w22: T,
    /// Standard deviations of Σ along x and y, in px.
    pub(crate) deviations: [T; 2],
    /// dx of the middle of a row of pixels through the ellipse, per dy.
    pub(crate) slope: T,
    /// dy of the ellipse's rightmost point, per dx.
    pub(crate) tilt: T,
    /// √(det A Aᵀ / det Σ): what `antialiased` scales opacity by.
    pub(crate) compensation: T,
    /// Whether Σ is neither singular nor out of range; if not, the other fields are of no meaning.
    pub(crate) sound: bool,
}

/// A and Σ in units that keep the determinant, which is a fourth power of lengths, within range.
struct Scaled<T> {
    /// One unit is 1/`unit` pixels.
    unit: T,
    r0: Vec3<T>,
    r1: Vec3<T>,
    eps: T,
    /// r₀ × r₁ and its square.
    n: Vec3<T>,
    area: T,
    /// Σ = [[a, b], [b, c]]
    a: T,
    b: T,
    c: T,
    /// det Σ − det A Aᵀ
    blur: T,
    det: T,
}

#[inline(always)]
fn scaled<T: Real>(r0: Vec3<T>, r1: Vec3<T>, eps: T) -> Scaled<T> {
    /// Rows longer than this many pixels are measured in units of themselves.
    const LONG: f64 = 1e6;
    let longest = |r: Vec3<T>| r[0].abs().greater(r[1].abs()).greater(r[2].abs());
    let length = longest(r0).greater(longest(r1));
    let unit = if length > T::of(LONG) {
        T::ONE / length
    } else {
        T::ONE
    };
    let (r0, r1, eps) = (
        three(|i| r0[i] * unit),
        three(|i| r1[i] * unit),
        eps * unit * unit,
    );
    let n = cross(r0, r1);
    let (a0, c0, area) = (dot(r0, r0), dot(r1, r1), dot(n, n));
    let blur = eps * (a0 + c0) + eps * eps;
    Scaled {
        unit,
        r0,
        r1,
        eps,
        n,
        area,
        a: a0 + eps,
        b: dot(r0, r1),
        c: c0 + eps,
        blur,
        det: area + blur,
    }
}

/// The whitening of A with rows `r0`, `r1`.
#[inline(always)]
pub(crate) fn whiten<T: Real>(r0: Vec3<T>, r1: Vec3<T>, eps: T) -> Whitening<T> {
    let s = scaled(r0, r1, eps);
    let scale = T::of(EXP2_SCALE) * s.unit;
    let w11 = scale * (s.c / s.det).sqrt();
    let slope = s.b / s.c;
    Whitening {
        w11,
        w12: -w11 * slope,
        w22: scale / s.c.sqrt(),
        deviations: [s.a.sqrt() / s.unit, s.c.sqrt() / s.unit],
        slope,
        tilt: s.b / s.a,
        compensation: (s.area / s.det).sqrt(),
        sound: (s.det >= T::TINY) & s.det.is_finite(),
    }
}

/// Gradients of the rows of A.
///
/// `moments` are Σ v_e·uu, Σ v_e·uv, Σ v_e·vv over pixels, where v_e is the gradient of the exponent of two. In
/// whitened coordinates the gradient of A is (2/κ²) Wᵀ · moments · P with P = W A and κ = √(½ log₂ e). Along a needle
/// the rows of A nearly cancel in P, so its first row is taken from c r₀ − b r₁ = r₁ × (r₀ × r₁) + ε r₀.
#[inline(always)]
pub(crate) fn whiten_vjp<T: Real>(
    r0: Vec3<T>,
    r1: Vec3<T>,
    eps: T,
    w: &Whitening<T>,
    moments: [T; 3],
    v_compensation: Option<T>,
) -> (Vec3<T>, Vec3<T>) {
    let s = scaled(r0, r1, eps);
    let two = T::ONE + T::ONE;
    let gain = T::of(2.0 / (EXP2_SCALE * EXP2_SCALE));
    let [uu, uv, vv] = moments;
    let across = cross(s.r1, s.n);
    let along = w.w11 / s.unit / s.c;
    let p0 = three(|i| along * (across[i] + s.eps * s.r0[i]));
    let p1 = three(|i| w.w22 / s.unit * s.r1[i]);
    let g0 = three(|i| gain * (uu * p0[i] + uv * p1[i]));
    let g1 = three(|i| gain * (uv * p0[i] + vv * p1[i]));
    let mut v_r0 = three(|i| w.w11 * g0[i]);
    let mut v_r1 = three(|i| w.w12 * g0[i] + w.w22 * g1[i]);
    if let Some(v_compensation) = v_compensation {
        // compensation = |n| / √det with n = r₀ × r₁
        let v_det = -v_compensation * w.compensation / (two * s.det);
        // Of n itself, and of det: where the blur is little they nearly cancel, and what is left is the blur's share.
        // No product of area and det is formed, which is an eighth power.
        let outward = if s.area >= T::TINY {
            v_compensation / s.area.sqrt() / s.det.sqrt() * (s.blur / s.det)
        } else {
            T::ZERO
        };
        let v_n = three(|i| s.n[i] * outward);
        let (from_r0, from_r1) = (cross(s.r1, v_n), cross(v_n, s.r0));
        for i in 0..3 {
            v_r0[i] += s.unit * (from_r0[i] + two * s.eps * v_det * s.r0[i]);
            v_r1[i] += s.unit * (from_r1[i] + two * s.eps * v_det * s.r1[i]);
        }
    }
    (v_r0, v_r1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn difference(mut f: impl FnMut(f64) -> f64) -> f64 {
        let h = 1e-6;
        (f(h) - f(-h)) / (2.0 * h)
    }

    #[test]
    fn rotation_gradient_is_the_derivative() {
        let q = [0.4, -1.1, 0.7, 0.2];
        let weights = [[0.3, -0.8, 1.0], [0.1, 0.7, -0.2], [-0.5, 0.9, 0.4]];
        let loss = |q| {
            let r = rotation_of(normalize_quat(q).0);
            (0..3).map(|i| dot(r[i], weights[i])).sum::<f64>()
        };
        let (unit, inverse) = normalize_quat(q);
        let gradient = rotation_vjp(unit, inverse, &weights);
        for i in 0..4 {
            let expected = difference(|h| {
                let mut moved = q;
                moved[i] += h;
                loss(moved)
            });
            assert!(
                (gradient[i] - expected).abs() < 1e-8,
                "{i}: {} {expected}",
                gradient[i]
            );
        }
    }

    #[test]
    fn whitening_gradient_is_the_derivative() {
        let rows = [[1.5, 0.2, -0.4], [0.3, 0.9, 0.1]];
        let (d, weight, eps) = ([0.7, -1.2], 0.8, 0.3);
        let value = |rows: [[f64; 3]; 2]| {
            let w = whiten(rows[0], rows[1], eps);
            let (u, v) = (w.w11 * d[0] + w.w12 * d[1], w.w22 * d[1]);
            -(u * u + v * v) + weight * w.compensation
        };
        let w = whiten(rows[0], rows[1], eps);
        let (u, v) = (w.w11 * d[0] + w.w12 * d[1], w.w22 * d[1]);
        let (g0, g1) = whiten_vjp(rows[0], rows[1], eps, &w, [u * u, u * v, v * v], Some(weight));
        for (row, gradient) in [(0, g0), (1, g1)] {
            for i in 0..3 {
                let expected = difference(|h| {
                    let mut moved = rows;
                    moved[row][i] += h;
                    value(moved)
                });
                assert!((gradient[i] - expected).abs() < 1e-8);
            }
        }
    }

    #[test]
    fn needles_keep_their_determinant() {
        // 300 px long with ratio 1e4: ac − b² in f32 loses two digits here.
        let (cos, sin) = (0.6f64, 0.8f64);
        let long = [300.0 * cos, 300.0 * sin];
        let short = [-0.03 * sin, 0.03 * cos];
        let exact = whiten([long[0], short[0], 0.0], [long[1], short[1], 0.0], 0.3);
        let single = whiten(
            [long[0] as f32, short[0] as f32, 0.0],
            [long[1] as f32, short[1] as f32, 0.0],
            0.3,
        );
        assert!((f64::from(single.w11) / exact.w11 - 1.0).abs() < 1e-6);
    }

    #[test]
    fn determinants_beyond_the_range_of_numbers_are_no_obstacle() {
        let w = whiten([3e15f32, 0.0, 0.0], [0.0, 1e15, 0.0], 0.3);
        assert!((f64::from(w.w11) * 3e15 / EXP2_SCALE - 1.0).abs() < 1e-6);
        assert!((f64::from(w.w22) * 1e15 / EXP2_SCALE - 1.0).abs() < 1e-6);
        assert!((w.deviations[0] / 3e15 - 1.0).abs() < 1e-6);
    }

    #[test]
    fn hopeless_covariances_are_refused() {
        assert!(!whiten([0.0f32; 3], [0.0; 3], 0.0).sound);
        assert!(!whiten([1e-20f32, 0.0, 0.0], [0.0, 1e-20, 0.0], 0.0).sound);
        assert_eq!(normalize_quat([0.0f32; 4]), ([0.0; 4], 0.0));
        assert_eq!(normalize_quat([1e-30f32, 0.0, 0.0, 0.0]).0, [1.0, 0.0, 0.0, 0.0]);
    }
}

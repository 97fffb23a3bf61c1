//! Light on a surface: the exponential of a quadratic function of its normal for the clip, and for a frame a linear one
//! with a constant for each of the subject's parts.

use bigs_raster::{Simd, Vectors};

use crate::lanes::{Four, Lanes, of};

/// Coefficients for the clip: eight functions of the normal, three colours each.
pub(crate) const CLIP: usize = 8;

/// The z axis turned by a quaternion of any length, and what its gradient needs.
pub(crate) struct Normal<T: Vectors, S: Simd> {
    pub(crate) axis: [Lanes<T, S>; 3],
    inverse: Lanes<T, S>,
    quat: Four<Lanes<T, S>>,
    /// 1 where the squared length is what divides, and 0 where it is too small for that.
    long: Lanes<T, S>,
}

impl<T: Vectors, S: Simd> Normal<T, S> {
    #[inline(always)]
    pub(crate) fn of(simd: S, quat: Four<Lanes<T, S>>) -> Self {
        let [w, x, y, z] = quat;
        let least = Lanes::splat(simd, of(1e-12));
        let squared = w * w + x * x + y * y + z * z;
        let inverse = Lanes::splat(simd, T::ONE).over(squared.max(least));
        let two = inverse + inverse;
        let long = Lanes::splat(simd, T::ONE).where_above(squared, least, Lanes::zero(simd));
        Self {
            axis: [
                two * (x * z + w * y),
                two * (y * z - w * x),
                inverse * (w * w - x * x - y * y + z * z),
            ],
            inverse,
            quat,
            long,
        }
    }

    /// The gradient of the quaternion.
    #[inline(always)]
    pub(crate) fn vjp(&self, v: [Lanes<T, S>; 3]) -> Four<Lanes<T, S>> {
        let [w, x, y, z] = self.quat;
        let two = self.inverse + self.inverse;
        // Of the length that divides: it matters as much as the axis is long along v.
        let along = self.long * (self.axis[0] * v[0] + self.axis[1] * v[1] + self.axis[2] * v[2]);
        [
            two * (y * v[0] - x * v[1] + w * (v[2] - along)),
            two * (z * v[0] - w * v[1] - x * (v[2] + along)),
            two * (w * v[0] + z * v[1] - y * (v[2] + along)),
            two * (x * v[0] + y * v[1] + z * (v[2] - along)),
        ]
    }
}

/// The linear and quadratic harmonics of unit vectors.
#[inline(always)]
pub(crate) fn basis<T: Vectors, S: Simd>(simd: S, [x, y, z]: [Lanes<T, S>; 3]) -> [Lanes<T, S>; CLIP] {
    let three = Lanes::splat(simd, of(3.0));
    [
        x,
        y,
        z,
        x * y,
        y * z,
        x * z,
        x * x - y * y,
        three * z * z - Lanes::splat(simd, T::ONE),
    ]
}

/// The gradient of the vectors.
#[inline(always)]
pub(crate) fn basis_vjp<T: Vectors, S: Simd>(
    simd: S,
    [x, y, z]: [Lanes<T, S>; 3],
    v: [Lanes<T, S>; CLIP],
) -> [Lanes<T, S>; 3] {
    let two = Lanes::splat(simd, of(2.0));
    let six = Lanes::splat(simd, of(6.0));
    [
        v[0] + y * v[3] + z * v[5] + two * x * v[6],
        v[1] + x * v[3] + z * v[4] - two * y * v[6],
        v[2] + y * v[4] + x * v[5] + six * z * v[7],
    ]
}

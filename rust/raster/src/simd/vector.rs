//! Vectors of floats behind one trait, which the kernels are written in.

use crate::math::real::Real;

/// Values that [`Vector::sums`] takes at most.
pub(crate) const MAX_SUMS: usize = 16;

/// `LANES` floats, and comparisons of them.
///
/// A vector can only be made with its level, so every method that takes one may use its instructions.
///
/// `min` and `max` yield `other` if self is NaN.
#[allow(unreachable_pub, missing_docs)]
pub trait Vector: Copy {
    type Scalar: Real;
    /// The instructions that it needs, as proof that the machine has them.
    type Level: Copy;
    /// True or false per lane.
    type Mask: Copy;
    const LANES: usize;

    /// The value in every lane.
    fn splat(level: Self::Level, value: Self::Scalar) -> Self;
    /// The first `LANES` values.
    fn load(level: Self::Level, values: &[Self::Scalar]) -> Self;
    /// The proof that it was made with.
    fn level(self) -> Self::Level;
    /// Into the first `LANES` values.
    fn store(self, values: &mut [Self::Scalar]);

    fn plus(self, other: Self) -> Self;
    fn minus(self, other: Self) -> Self;
    fn times(self, other: Self) -> Self;
    fn over(self, other: Self) -> Self;
    /// self · a + b, in one rounding where there is such an instruction.
    fn times_plus(self, a: Self, b: Self) -> Self;
    /// self · a − b
    fn times_minus(self, a: Self, b: Self) -> Self;
    /// b − self · a
    fn times_from(self, a: Self, b: Self) -> Self;
    /// −self · a − b
    fn minus_times_minus(self, a: Self, b: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    /// 2^x for x ≤ 0 by a polynomial of DEGREE, or of degree 12 in double precision; zero, or next to it, below the
    /// range of normal numbers.
    fn exp2<const DEGREE: usize>(self) -> Self;

    /// self ≥ other
    fn at_least(self, other: Self) -> Self::Mask;
    /// self ≥ other where the mask holds.
    #[inline(always)]
    fn at_least_where(self, other: Self, mask: Self::Mask) -> Self::Mask {
        Self::both(mask, self.at_least(other))
    }
    /// self > other
    fn above(self, other: Self) -> Self::Mask;
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// One bit per lane, the first lane lowest.
    fn bits(mask: Self::Mask) -> u32;
    /// self where the mask holds, else `other`.
    fn select(self, mask: Self::Mask, other: Self) -> Self;
    /// self where the mask holds, else 0.
    fn keep(self, mask: Self::Mask) -> Self;

    /// The sum of the lanes of each of 1 ≤ N ≤ `MAX_SUMS` vectors, in the same order of additions for each.
    fn sums<const N: usize>(vectors: &[Self; N]) -> [Self::Scalar; MAX_SUMS];
}

/// Least and greatest degree of [`Vector::exp2`] in single precision.
const ROUGHEST: usize = 3;
pub(crate) const FINEST: usize = 5;

/// Coefficients of 2^f on [-½, ½], f32, for each degree: minimax with c₀ = 1, relative errors 1.0e-4, 2.8e-6 and 9e-8.
/// Fitted: c₁ is not ln 2.
#[allow(clippy::approx_constant)]
pub(super) const EXP2_F32: [[f32; FINEST + 1]; 3] = [
    [1.0, 0.693_282_9, 0.242_210_95, 0.055_008_933, 0.0, 0.0],
    [1.0, 0.693_124_2, 0.240_240_99, 0.055_906_426, 0.009_582_853, 0.0],
    [
        1.0,
        0.693_147,
        0.240_222_42,
        0.055_507_337,
        0.009_671_513,
        0.001_326_472_7,
    ],
];
/// The same on [0, 1]: relative errors 8.6e-5, 2.9e-6 and 8e-8; that of degree 5 has a mean of zero.
#[cfg(target_arch = "x86_64")]
pub(super) const EXP2_F32_FLOOR: [[f32; FINEST + 1]; 3] = [
    [1.0, 0.695_116_76, 0.227_645, 0.077_067_05, 0.0, 0.0],
    [1.0, 0.693_044_84, 0.241_280_2, 0.052_242_473, 0.013_426_684, 0.0],
    [
        1.0,
        0.693_151_3,
        0.240_164_44,
        0.055_799_913,
        0.009_017_031,
        0.001_867_13,
    ],
];

/// The coefficients for a degree.
#[inline(always)]
pub(super) const fn exp2_f32<const DEGREE: usize>(table: &[[f32; FINEST + 1]; 3]) -> &[f32] {
    table[DEGREE - ROUGHEST].split_at(DEGREE + 1).0
}
/// 2^f on [-½, ½], f64: (ln 2)ᵏ / k! to degree 12, relative error 2e-16.
pub(super) const EXP2_F64: [f64; 13] = [
    1.0,
    std::f64::consts::LN_2,
    0.240_226_506_959_100_7,
    0.055_504_108_664_821_576,
    0.009_618_129_107_628_477,
    0.001_333_355_814_642_844_1,
    0.000_154_035_303_933_816_06,
    1.525_273_380_405_984e-5,
    1.321_548_679_014_430_5e-6,
    1.017_808_600_923_969_7e-7,
    7.054_911_620_801_121e-9,
    4.445_538_271_870_81e-10,
    2.567_843_599_348_82e-11,
];

/// Horner's rule.
#[inline(always)]
pub(super) fn polynomial<V: Vector>(x: V, coefficients: &[V::Scalar]) -> V {
    let mut k = coefficients.len() - 1;
    let mut sum = V::splat(x.level(), coefficients[k]);
    while k > 0 {
        k -= 1;
        sum = sum.times_plus(x, V::splat(x.level(), coefficients[k]));
    }
    sum
}

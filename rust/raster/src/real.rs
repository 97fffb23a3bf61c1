//! The scalar the whole pipeline is generic over: `f32` for work, `f64` for truth.

use std::fmt::{Debug, Display};
use std::hint::select_unpredictable;
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

use crate::sort::RadixKey;

/// `f32` or `f64`.
pub trait Real:
    Copy
    + Default
    + Debug
    + Display
    + PartialOrd
    + Send
    + Sync
    + Sum
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + 'static
{
    /// The integer of the same width, ordered as the scalar is.
    type Key: RadixKey;
    /// 0
    const ZERO: Self;
    /// 1
    const ONE: Self;
    /// The smallest positive normal number.
    const TINY: Self;
    /// Below this transmittance a pixel stops whatever the settings: nothing behind it can be seen in this
    /// precision, and the backward pass recovers transmittances by division, which denormals would spoil.
    const TRANSMITTANCE_FLOOR: Self;

    /// The nearest value of this type.
    fn of(value: f64) -> Self;
    /// Exact.
    fn as_f64(self) -> f64;
    /// √x
    fn sqrt(self) -> Self;
    /// |x|
    fn abs(self) -> Self;
    /// log₂ x for a positive normal x, without branches.
    fn log2(self) -> Self;
    /// ⌊x⌋ for 0 ≤ x < 2³¹.
    fn truncate(self) -> usize;
    /// Neither NaN nor infinite.
    fn is_finite(self) -> bool;
    /// self · a + b in one rounding; slow where the CPU has no such instruction.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// An integer that sorts as this number does.
    fn key(self) -> Self::Key;
    /// 2^x for x ≤ 0 without branches; 0 below the range of normal numbers.
    fn exp2_of_nonpositive<A: Arithmetic>(self) -> Self;

    /// 1/x for x in (0, 1], to the last bit or two.
    fn reciprocal<A: Arithmetic>(self) -> Self;

    /// The lesser; `other` if either is NaN. One instruction, unlike `f32::min`.
    #[inline(always)]
    fn lesser(self, other: Self) -> Self {
        if self < other { self } else { other }
    }
    /// The greater; `other` if either is NaN.
    #[inline(always)]
    fn greater(self, other: Self) -> Self {
        if self > other { self } else { other }
    }
    /// Limits to `[low, high]`; `low` wins if they cross.
    #[inline(always)]
    fn limit(self, low: Self, high: Self) -> Self {
        self.lesser(high).greater(low)
    }
}

/// How a·b + c is computed, chosen once per kernel: `mul_add` on a CPU without the instruction is a library call.
pub trait Arithmetic: 'static {
    /// Whether a·b + c is one instruction.
    const FUSED: bool;
    /// a·b + c
    fn mul_add<T: Real>(a: T, b: T, c: T) -> T;
}

/// One rounding.
pub(crate) struct Fused;
/// Two roundings, two instructions.
pub(crate) struct Separate;

impl Arithmetic for Fused {
    const FUSED: bool = true;
    #[inline(always)]
    fn mul_add<T: Real>(a: T, b: T, c: T) -> T {
        a.mul_add(b, c)
    }
}

impl Arithmetic for Separate {
    const FUSED: bool = false;
    #[inline(always)]
    fn mul_add<T: Real>(a: T, b: T, c: T) -> T {
        a * b + c
    }
}

/// 2^f on [-½, ½], f32: degree 5, minimax with c₀ = 1, relative error 9e-8. Fitted: c₁ is not ln 2.
#[allow(clippy::approx_constant)]
const EXP2_F32: [f32; 6] = [
    1.0,
    0.693_147,
    0.240_222_42,
    0.055_507_337,
    0.009_671_513,
    0.001_326_472_7,
];
/// 2^f on [-½, ½], f64: (ln 2)ᵏ / k! to degree 12, relative error 2e-16.
const EXP2_F64: [f64; 13] = [
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

macro_rules! real {
    ($T:ty, $Key:ty, $coefficients:ident, mantissa $mantissa:literal, magic $magic:literal, lowest $lowest:literal, floor $floor:literal, newton $newton:expr) => {
        impl Real for $T {
            type Key = $Key;
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            const TINY: Self = <$T>::MIN_POSITIVE;
            const TRANSMITTANCE_FLOOR: Self = $floor;

            #[inline(always)]
            fn of(value: f64) -> Self {
                value as $T
            }
            #[inline(always)]
            fn as_f64(self) -> f64 {
                self as f64
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$T>::sqrt(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                <$T>::abs(self)
            }
            #[inline(always)]
            fn log2(self) -> Self {
                // x = m 2ᵉ with m in [√½, √2); log₂ m is 2/ln 2 · artanh((m − 1)/(m + 1)), a series in odd powers.
                let least = (std::f64::consts::FRAC_1_SQRT_2 as $T).to_bits();
                let bits = self.to_bits();
                let exponent = bits.wrapping_sub(least).cast_signed() >> $mantissa;
                let m = <$T>::from_bits(bits.wrapping_sub((exponent << $mantissa).cast_unsigned()));
                let s = (m - 1.0) / (m + 1.0);
                let mut sum = 0.0;
                let mut k = $coefficients.len();
                while k > 0 {
                    k -= 1;
                    sum = sum * (s * s) + (2.0 * std::f64::consts::LOG2_E / (2 * k + 1) as f64) as $T;
                }
                exponent as $T + s * sum
            }
            #[inline(always)]
            fn truncate(self) -> usize {
                self as i32 as usize
            }
            #[inline(always)]
            fn is_finite(self) -> bool {
                <$T>::is_finite(self)
            }
            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                <$T>::mul_add(self, a, b)
            }
            #[inline(always)]
            fn key(self) -> Self::Key {
                // Negative floats sort in reverse as integers: flip them whole, and the sign of the rest.
                let bits = self.to_bits();
                let sign = 1 << (<$Key>::BITS - 1);
                if bits & sign == 0 { bits | sign } else { !bits }
            }
            #[inline(always)]
            fn reciprocal<A: Arithmetic>(self) -> Self {
                // A vector of quotients takes as long as a dozen multiply-adds; three Newton steps from a guess off
                // by 12 % (the exponent negated) take six.
                let guess: Option<$Key> = $newton;
                match guess {
                    Some(guess) if A::FUSED => {
                        let mut r = <$T>::from_bits(guess.wrapping_sub(self.to_bits()));
                        for _ in 0..3 {
                            r = A::mul_add(r, A::mul_add(-self, r, 1.0), r);
                        }
                        r
                    }
                    _ => 1.0 / self,
                }
            }
            #[inline(always)]
            fn exp2_of_nonpositive<A: Arithmetic>(self) -> Self {
                // Adding 1.5·2^mantissa rounds to an integer and leaves it in the low bits.
                let clipped = self.greater($lowest);
                let shifted = clipped + $magic;
                let fraction = clipped - (shifted - $magic);
                let mut power = $coefficients[$coefficients.len() - 1];
                let mut k = $coefficients.len() - 1;
                while k > 0 {
                    k -= 1;
                    power = A::mul_add(power, fraction, $coefficients[k]);
                }
                let scaled = <$T>::from_bits(power.to_bits().wrapping_add(shifted.to_bits() << $mantissa));
                select_unpredictable(self < $lowest, 0.0, scaled)
            }
        }
    };
}

real!(f32, u32, EXP2_F32, mantissa 23, magic 12_582_912.0, lowest -126.0, floor 1e-30, newton Some(0x7EF3_11C3));
real!(f64, u64, EXP2_F64, mantissa 52, magic 6_755_399_441_055_744.0, lowest -1022.0, floor 1e-290, newton None);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp2_matches_the_library() {
        for i in 0..=40_000 {
            let x = -f64::from(i) * 0.003;
            let exact = x.exp2();
            let double: f64 = x.exp2_of_nonpositive::<Fused>();
            assert!(
                (double - exact).abs() <= 6e-16 * exact,
                "{x}: {double} against {exact}"
            );
            let x32 = x as f32;
            let single: f32 = x32.exp2_of_nonpositive::<Separate>();
            let exact = f64::from(x32).exp2();
            assert!((f64::from(single) - exact).abs() <= 3e-7 * exact, "{x}: {single}");
        }
        assert_eq!(0f32.exp2_of_nonpositive::<Fused>(), 1.0);
        assert_eq!((-1e9f32).exp2_of_nonpositive::<Fused>(), 0.0);
        assert_eq!(f64::NEG_INFINITY.exp2_of_nonpositive::<Fused>(), 0.0);
    }

    #[test]
    fn reciprocals_are_exact_to_two_bits() {
        for i in 1..=10_000 {
            let x = i as f32 * 1e-4;
            let error = f64::from(x.reciprocal::<Fused>()) * f64::from(x) - 1.0;
            assert!(error.abs() < 2.5e-7, "{x}: {error}");
            assert_eq!(x.reciprocal::<Separate>(), 1.0 / x);
        }
    }

    #[test]
    fn log2_matches_the_library() {
        let mut x = f64::from(f32::MIN_POSITIVE);
        while x < f64::from(f32::MAX) {
            let exact = x.log2();
            assert!(
                (Real::log2(x) - exact).abs() <= 1e-15 * (1.0 + exact.abs()),
                "{x}"
            );
            let single = Real::log2(x as f32);
            let exact = f64::from(x as f32).log2();
            assert!(
                (f64::from(single) - exact).abs() <= 2e-7 * (1.0 + exact.abs()),
                "{x}"
            );
            x *= 1.003;
        }
        assert_eq!((Real::log2(1f32), Real::log2(8f64)), (0.0, 3.0));
    }

    #[test]
    fn keys_sort_as_numbers_do() {
        let sorted = [-1e30f32, -1.0, -1e-40, 0.0, 1e-40, 0.5, 1.0, 3.0e7, f32::MAX];
        assert!(sorted.windows(2).all(|pair| pair[0].key() < pair[1].key()));
    }
}

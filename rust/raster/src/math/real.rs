//! The arithmetic the whole pipeline is generic over: `f32` for work, `f64` for truth.

use std::fmt::{Debug, Display};
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

use rayon::prelude::*;

use crate::math::radix_key::RadixKey;

/// What only the two scalars below are.
mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// The arithmetic of `f32` and `f64`. Sealed: no other type can implement it.
pub trait Real:
    sealed::Sealed
    + Copy
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
    /// Whether the degree of the polynomial for powers of two can be chosen.
    const HAS_EXP_DEGREES: bool;

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
    /// The nearest integer to x, for 0 ≤ x ≤ 2²², without branches.
    fn nearest(self) -> u32;
    /// ⌈x⌉, likewise.
    fn ceiling(self) -> u32;
    /// Neither NaN nor infinite.
    fn is_finite(self) -> bool;
    /// Where the first NaN or infinity is. Compiled in this crate, unlike a generic function, because it reads every
    /// input of every call.
    fn first_not_finite(values: &[Self]) -> Option<usize>;
    /// self · a + b in one rounding; slow where the CPU has no such instruction.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// An integer that sorts as this number does.
    fn key(self) -> Self::Key;
    /// A number that compares with others of its kind as the places do; above 0. Exact for a milliard places.
    fn ordinal(place: u32) -> Self;
    /// One more than the place that [`Real::ordinal`] made this number of, 0 for 0.
    fn past_ordinal(self) -> u32;

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

macro_rules! real {
    ($T:ty, $Key:ty, mantissa $mantissa:literal, terms $terms:literal, floor $floor:literal, degrees $degrees:literal) => {
        impl Real for $T {
            type Key = $Key;
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            const TINY: Self = <$T>::MIN_POSITIVE;
            const TRANSMITTANCE_FLOOR: Self = $floor;
            const HAS_EXP_DEGREES: bool = $degrees;

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
                let mut k = $terms;
                while k > 0 {
                    k -= 1;
                    sum = sum * (s * s) + (2.0 * std::f64::consts::LOG2_E / (2 * k + 1) as f64) as $T;
                }
                exponent as $T + s * sum
            }
            #[inline(always)]
            fn nearest(self) -> u32 {
                // Adding 2ᵐ leaves the integer in the low bits of the mantissa.
                let magic = (1u64 << $mantissa) as $T;
                (self + magic).to_bits() as u32 & 0x7F_FFFF
            }
            #[inline(always)]
            fn ceiling(self) -> u32 {
                let magic = (1u64 << $mantissa) as $T;
                let nearest = (self + magic) - magic;
                self.nearest() + u32::from(nearest < self)
            }
            #[inline(always)]
            fn is_finite(self) -> bool {
                <$T>::is_finite(self)
            }
            fn first_not_finite(values: &[Self]) -> Option<usize> {
                // A loop to the end vectorises, a search that may stop early does not; nor need it be widened to count.
                let finite = values.par_chunks(1 << 14).all(|part| {
                    part.iter()
                        .fold(0, |any, v| any | <$Key>::from(!v.is_finite()))
                        == 0
                });
                if finite {
                    return None;
                }
                values.iter().position(|v| !v.is_finite())
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
            fn ordinal(place: u32) -> Self {
                // Positive floats sort as their bits do, and these start at 1, clear of denormals.
                <$T>::from_bits((1.0 as $T).to_bits() + place as $Key)
            }
            #[inline(always)]
            fn past_ordinal(self) -> u32 {
                (self.to_bits() + 1).saturating_sub((1.0 as $T).to_bits()) as u32
            }
        }
    };
}

real!(f32, u32, mantissa 23, terms 6, floor 1e-30, degrees true);
real!(f64, u64, mantissa 52, terms 13, floor 1e-290, degrees false);

#[cfg(test)]
mod tests {
    use super::*;

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
            x *= if cfg!(miri) { 3.1 } else { 1.003 };
        }
        assert_eq!((Real::log2(1f32), Real::log2(8f64)), (0.0, 3.0));
    }

    #[test]
    fn integers_are_exact() {
        for x in [
            0.0f64,
            0.25,
            0.75,
            1.0,
            1e-30,
            41.01,
            4096.999,
            4_194_303.6,
            4_194_304.0,
        ] {
            assert_eq!(Real::nearest(x), x.round() as u32, "{x}");
            assert_eq!(Real::ceiling(x), x.ceil() as u32, "{x}");
            let x = x as f32;
            assert_eq!(
                (x.nearest(), x.ceiling()),
                (x.round() as u32, x.ceil() as u32),
                "{x}"
            );
        }
    }

    #[test]
    fn keys_sort_as_numbers_do() {
        let sorted = [-1e30f32, -1.0, -1e-40, 0.0, 1e-40, 0.5, 1.0, 3.0e7, f32::MAX];
        assert!(sorted.windows(2).all(|pair| pair[0].key() < pair[1].key()));
    }

    #[test]
    fn ordinals_compare_as_places_do() {
        for place in [0, 1, 2, 1 << 24, (1 << 24) + 1, 1_000_000_000] {
            assert!(0.0 < f32::ordinal(place) && f32::ordinal(place) < f32::ordinal(place + 1));
            assert_eq!(f32::ordinal(place).past_ordinal(), place + 1);
            assert_eq!(f64::ordinal(place).past_ordinal(), place + 1);
        }
        assert_eq!(0f32.past_ordinal(), 0);
    }
}

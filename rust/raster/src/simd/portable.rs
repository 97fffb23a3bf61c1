//! Arrays of four floats, for targets without a vector type of their own, and for tests of the others.

use crate::simd::level::{Simd, Work};
use crate::simd::vector::{EXP2_F32, EXP2_F64, MAX_SUMS, Vector, exp2_f32, polynomial};

/// No vector instructions at all.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Portable(());

impl Portable {
    /// Every machine has this.
    pub(crate) fn guaranteed() -> Self {
        Self(())
    }
}

impl Simd for Portable {
    type F32 = Array<f32>;
    type F64 = Array<f64>;

    #[inline(always)]
    fn run<W: Work>(self, work: W) -> W::Output {
        work.run(self)
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Array<T>([T; 4]);

macro_rules! array {
    ($T:ty, $Bits:ty, $coefficients:expr, $lowest:literal, $magic:literal, $mantissa:literal) => {
        impl Array<$T> {
            #[inline(always)]
            fn map2(self, other: Self, f: impl Fn($T, $T) -> $T) -> Self {
                Self([0, 1, 2, 3].map(|i| f(self.0[i], other.0[i])))
            }
        }

        impl Vector for Array<$T> {
            type Scalar = $T;
            type Level = Portable;
            type Mask = [bool; 4];
            const LANES: usize = 4;

            #[inline(always)]
            fn splat(_: Portable, value: $T) -> Self {
                Self([value; 4])
            }
            #[inline(always)]
            fn load(_: Portable, values: &[$T]) -> Self {
                Self([values[0], values[1], values[2], values[3]])
            }
            #[inline(always)]
            fn level(self) -> Portable {
                Portable(())
            }
            #[inline(always)]
            fn store(self, values: &mut [$T]) {
                values[..4].copy_from_slice(&self.0);
            }
            #[inline(always)]
            fn plus(self, other: Self) -> Self {
                self.map2(other, |a, b| a + b)
            }
            #[inline(always)]
            fn minus(self, other: Self) -> Self {
                self.map2(other, |a, b| a - b)
            }
            #[inline(always)]
            fn times(self, other: Self) -> Self {
                self.map2(other, |a, b| a * b)
            }
            #[inline(always)]
            fn over(self, other: Self) -> Self {
                self.map2(other, |a, b| a / b)
            }
            #[inline(always)]
            fn times_plus(self, a: Self, b: Self) -> Self {
                self.times(a).plus(b)
            }
            #[inline(always)]
            fn times_minus(self, a: Self, b: Self) -> Self {
                self.times(a).minus(b)
            }
            #[inline(always)]
            fn times_from(self, a: Self, b: Self) -> Self {
                b.minus(self.times(a))
            }
            #[inline(always)]
            fn minus_times_minus(self, a: Self, b: Self) -> Self {
                Self([0.0; 4]).minus(self.times(a).plus(b))
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                self.map2(other, |a, b| if a < b { a } else { b })
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                self.map2(other, |a, b| if a > b { a } else { b })
            }
            #[inline(always)]
            fn exp2<const DEGREE: usize>(self) -> Self {
                // Adding 1.5 · 2^mantissa rounds to an integer and leaves it in the low bits.
                let magic = Self([$magic; 4]);
                let clipped = self.max(Self([$lowest; 4]));
                let shifted = clipped.plus(magic);
                let power = polynomial(clipped.minus(shifted.minus(magic)), $coefficients);
                power.map2(shifted, |p, s| {
                    <$T>::from_bits(p.to_bits().wrapping_add(s.to_bits() << $mantissa))
                })
            }
            #[inline(always)]
            fn at_least(self, other: Self) -> [bool; 4] {
                [0, 1, 2, 3].map(|i| self.0[i] >= other.0[i])
            }
            #[inline(always)]
            fn above(self, other: Self) -> [bool; 4] {
                [0, 1, 2, 3].map(|i| self.0[i] > other.0[i])
            }
            #[inline(always)]
            fn both(a: [bool; 4], b: [bool; 4]) -> [bool; 4] {
                [0, 1, 2, 3].map(|i| a[i] & b[i])
            }
            #[inline(always)]
            fn bits(mask: [bool; 4]) -> u32 {
                (0..4).map(|i| u32::from(mask[i]) << i).sum()
            }
            #[inline(always)]
            fn select(self, mask: [bool; 4], other: Self) -> Self {
                Self([0, 1, 2, 3].map(|i| if mask[i] { self.0[i] } else { other.0[i] }))
            }
            #[inline(always)]
            fn keep(self, mask: [bool; 4]) -> Self {
                self.select(mask, Self([0.0; 4]))
            }
            #[inline(always)]
            fn sums<const N: usize>(vectors: &[Self; N]) -> [$T; MAX_SUMS] {
                let mut sums = [0.0; MAX_SUMS];
                for (sum, Self([a, b, c, d])) in sums.iter_mut().zip(vectors) {
                    *sum = (a + c) + (b + d);
                }
                sums
            }
        }
    };
}
array!(f32, u32, exp2_f32::<DEGREE>(&EXP2_F32), -126.0, 12_582_912.0, 23);
array!(f64, u64, &EXP2_F64, -1022.0, 6_755_399_441_055_744.0, 52);

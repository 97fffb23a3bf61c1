//! ARM's 128-bit vectors.
#![allow(unsafe_code)]

use std::arch::aarch64::*;

use crate::simd::level::{Simd, Work};
use crate::simd::vector::{EXP2_F32, EXP2_F64, MAX_SUMS, Vector, exp2_f32, polynomial};

/// Calls an intrinsic that touches no memory.
macro_rules! op {
    ($e:expr) => {
        // SAFETY: NEON is part of the aarch64 targets.
        unsafe { $e }
    };
}

/// NEON, which every 64-bit ARM has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Neon(());

impl Neon {
    /// Part of the target.
    pub(crate) fn guaranteed() -> Self {
        Self(())
    }
}

impl Simd for Neon {
    type F32 = F32x4;
    type F64 = F64x2;

    #[inline(always)]
    fn run<W: Work>(self, work: W) -> W::Output {
        work.run(self)
    }
}

macro_rules! neon {
    ($Name:ident, $V:ty, $T:ty, $Mask:ty, $lanes:literal, $dup:ident, $ld:ident, $st:ident, $add:ident, $sub:ident, $mul:ident,
     $div:ident, $fma:ident, $fms:ident, $neg:ident, $min:ident, $max:ident, $ge:ident, $gt:ident, $and:ident, $bsl:ident,
     $sum:ident, $coefficients:expr, $lowest:literal, $magic:literal, $mantissa:literal, $to_int:ident,
     $from_int:ident, $shift:ident, $add_int:ident) => {
        #[derive(Clone, Copy)]
        pub(crate) struct $Name($V);

        impl Vector for $Name {
            type Scalar = $T;
            type Level = Neon;
            type Mask = $Mask;
            const LANES: usize = $lanes;

            #[inline(always)]
            fn splat(_: Neon, value: $T) -> Self {
                Self(op!($dup(value)))
            }
            #[inline(always)]
            fn load(_: Neon, values: &[$T]) -> Self {
                let values = &values[..$lanes];
                // SAFETY: the slice holds LANES values.
                Self(unsafe { $ld(values.as_ptr()) })
            }
            #[inline(always)]
            fn level(self) -> Neon {
                Neon(())
            }
            #[inline(always)]
            fn store(self, values: &mut [$T]) {
                let values = &mut values[..$lanes];
                // SAFETY: the slice holds LANES values.
                unsafe { $st(values.as_mut_ptr(), self.0) }
            }
            #[inline(always)]
            fn plus(self, other: Self) -> Self {
                Self(op!($add(self.0, other.0)))
            }
            #[inline(always)]
            fn minus(self, other: Self) -> Self {
                Self(op!($sub(self.0, other.0)))
            }
            #[inline(always)]
            fn times(self, other: Self) -> Self {
                Self(op!($mul(self.0, other.0)))
            }
            #[inline(always)]
            fn over(self, other: Self) -> Self {
                Self(op!($div(self.0, other.0)))
            }
            #[inline(always)]
            fn times_plus(self, a: Self, b: Self) -> Self {
                Self(op!($fma(b.0, self.0, a.0)))
            }
            #[inline(always)]
            fn times_minus(self, a: Self, b: Self) -> Self {
                Self(op!($fma($neg(b.0), self.0, a.0)))
            }
            #[inline(always)]
            fn times_from(self, a: Self, b: Self) -> Self {
                Self(op!($fms(b.0, self.0, a.0)))
            }
            #[inline(always)]
            fn minus_times_minus(self, a: Self, b: Self) -> Self {
                Self(op!($neg($fma(b.0, self.0, a.0))))
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                Self(op!($min(self.0, other.0)))
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                Self(op!($max(self.0, other.0)))
            }
            #[inline(always)]
            fn exp2<const DEGREE: usize>(self) -> Self {
                // Adding 1.5 · 2^mantissa rounds to an integer and leaves it in the low bits.
                let magic = Self(op!($dup($magic)));
                let clipped = self.max(Self(op!($dup($lowest))));
                let shifted = clipped.plus(magic);
                let power = polynomial(clipped.minus(shifted.minus(magic)), $coefficients);
                Self(op!($from_int($add_int(
                    $to_int(power.0),
                    $shift::<$mantissa>($to_int(shifted.0))
                ))))
            }
            #[inline(always)]
            fn at_least(self, other: Self) -> $Mask {
                op!($ge(self.0, other.0))
            }
            #[inline(always)]
            fn above(self, other: Self) -> $Mask {
                op!($gt(self.0, other.0))
            }
            #[inline(always)]
            fn both(a: $Mask, b: $Mask) -> $Mask {
                op!($and(a, b))
            }
            #[inline(always)]
            fn bits(mask: $Mask) -> u32 {
                let mut bits = 0;
                // SAFETY: a mask is as many integers as there are lanes, of the scalar's width.
                let lanes: [[u8; size_of::<$T>()]; $lanes] = unsafe { std::mem::transmute(mask) };
                for (i, lane) in lanes.iter().enumerate() {
                    bits |= u32::from(lane[0] & 1) << i;
                }
                bits
            }
            #[inline(always)]
            fn select(self, mask: $Mask, other: Self) -> Self {
                Self(op!($bsl(mask, self.0, other.0)))
            }
            #[inline(always)]
            fn keep(self, mask: $Mask) -> Self {
                self.select(mask, Self(op!($dup(0.0))))
            }
            #[inline(always)]
            fn sums<const N: usize>(vectors: &[Self; N]) -> [$T; MAX_SUMS] {
                let mut sums = [0.0; MAX_SUMS];
                for (sum, vector) in sums.iter_mut().zip(vectors) {
                    *sum = op!($sum(vector.0));
                }
                sums
            }
        }
    };
}

neon!(
    F32x4,
    float32x4_t,
    f32,
    uint32x4_t,
    4,
    vdupq_n_f32,
    vld1q_f32,
    vst1q_f32,
    vaddq_f32,
    vsubq_f32,
    vmulq_f32,
    vdivq_f32,
    vfmaq_f32,
    vfmsq_f32,
    vnegq_f32,
    vminnmq_f32,
    vmaxnmq_f32,
    vcgeq_f32,
    vcgtq_f32,
    vandq_u32,
    vbslq_f32,
    vaddvq_f32,
    exp2_f32::<DEGREE>(&EXP2_F32),
    -126.0,
    12_582_912.0,
    23,
    vreinterpretq_s32_f32,
    vreinterpretq_f32_s32,
    vshlq_n_s32,
    vaddq_s32
);
neon!(
    F64x2,
    float64x2_t,
    f64,
    uint64x2_t,
    2,
    vdupq_n_f64,
    vld1q_f64,
    vst1q_f64,
    vaddq_f64,
    vsubq_f64,
    vmulq_f64,
    vdivq_f64,
    vfmaq_f64,
    vfmsq_f64,
    vnegq_f64,
    vminnmq_f64,
    vmaxnmq_f64,
    vcgeq_f64,
    vcgtq_f64,
    vandq_u64,
    vbslq_f64,
    vaddvq_f64,
    &EXP2_F64,
    -1022.0,
    6_755_399_441_055_744.0,
    52,
    vreinterpretq_s64_f64,
    vreinterpretq_f64_s64,
    vshlq_n_s64,
    vaddq_s64
);

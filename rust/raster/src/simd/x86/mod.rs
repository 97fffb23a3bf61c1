//! SSE2, AVX2 with FMA, and AVX-512.
#![allow(unsafe_code)]

use std::arch::x86_64::*;

use crate::simd::level::{Simd, Work};
use crate::simd::vector::Vector;

/// Calls an intrinsic that touches no memory.
macro_rules! op {
    ($e:expr) => {
        // SAFETY: a vector is only made with its level, which only a machine with these instructions has. They touch no
        // memory.
        unsafe { $e }
    };
}

/// Methods that are one intrinsic for every x86 vector.
macro_rules! common {
    ($Level:ident, $T:ty, $lanes:literal, $set1:ident, $loadu:ident, $storeu:ident, $add:ident, $sub:ident, $mul:ident, $min:ident, $max:ident) => {
        type Scalar = $T;
        type Level = super::$Level;
        const LANES: usize = $lanes;
        #[inline(always)]
        fn splat(_: super::$Level, value: $T) -> Self {
            Self(op!($set1(value)))
        }
        #[inline(always)]
        fn load(_: super::$Level, values: &[$T]) -> Self {
            let values = &values[..$lanes];
            // SAFETY: the slice holds LANES values, and the load may be unaligned.
            Self(unsafe { $loadu(values.as_ptr()) })
        }
        #[inline(always)]
        fn level(self) -> super::$Level {
            // The vector was made with one.
            super::$Level(())
        }
        #[inline(always)]
        fn store(self, values: &mut [$T]) {
            let values = &mut values[..$lanes];
            // SAFETY: the slice holds LANES values, and the store may be unaligned.
            unsafe { $storeu(values.as_mut_ptr(), self.0) }
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
        fn min(self, other: Self) -> Self {
            Self(op!($min(self.0, other.0)))
        }
        #[inline(always)]
        fn max(self, other: Self) -> Self {
            Self(op!($max(self.0, other.0)))
        }
    };
}

macro_rules! divided {
    ($div:ident) => {
        #[inline(always)]
        fn over(self, other: Self) -> Self {
            Self(op!($div(self.0, other.0)))
        }
    };
}

macro_rules! fused {
    ($fmadd:ident, $fmsub:ident, $fnmadd:ident, $fnmsub:ident) => {
        #[inline(always)]
        fn times_plus(self, a: Self, b: Self) -> Self {
            Self(op!($fmadd(self.0, a.0, b.0)))
        }
        #[inline(always)]
        fn times_minus(self, a: Self, b: Self) -> Self {
            Self(op!($fmsub(self.0, a.0, b.0)))
        }
        #[inline(always)]
        fn times_from(self, a: Self, b: Self) -> Self {
            Self(op!($fnmadd(self.0, a.0, b.0)))
        }
        #[inline(always)]
        fn minus_times_minus(self, a: Self, b: Self) -> Self {
            Self(op!($fnmsub(self.0, a.0, b.0)))
        }
    };
}

/// Two roundings: before FMA there is nothing else.
macro_rules! separate {
    ($set1:ident) => {
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
            Self(op!($set1(0.0))).minus(self.times(a).plus(b))
        }
    };
}

/// 2^x by rounding to the nearest integer, which adding 1.5 · 2^mantissa does and leaves in the low bits.
macro_rules! exp2_by_bits {
    ($set1:ident, $coefficients:expr, $lowest:literal, $magic:literal, $mantissa:literal, $to_int:ident, $from_int:ident, $shift:ident, $add:ident) => {
        #[inline(always)]
        fn exp2<const DEGREE: usize>(self) -> Self {
            let magic = Self(op!($set1($magic)));
            let clipped = self.max(Self(op!($set1($lowest))));
            let shifted = clipped.plus(magic);
            let fraction = clipped.minus(shifted.minus(magic));
            let power = polynomial(fraction, $coefficients);
            Self(op!($from_int($add(
                $to_int(power.0),
                $shift::<$mantissa>($to_int(shifted.0))
            ))))
        }
    };
}

/// The vector with this number, or zero.
#[inline(always)]
fn nth<V: Vector<Scalar = f32>, const N: usize>(vectors: &[V; N], i: usize) -> V {
    const { assert!(N > 0) };
    if i < N {
        vectors[i]
    } else {
        V::splat(vectors[0].level(), 0.0)
    }
}

/// Four sums at once, each 128-bit part by itself: yields (a, b, c, d) in every part.
macro_rules! fold4 {
    ($v:expr, $first:expr, $lo:ident, $hi:ident, $lo2:ident, $hi2:ident, $add:ident, $cast:ident, $back:ident) => {{
        let (a, b) = (nth($v, $first).0, nth($v, $first + 1).0);
        let (c, d) = (nth($v, $first + 2).0, nth($v, $first + 3).0);
        op!({
            let ab = $add($lo(a, b), $hi(a, b));
            let cd = $add($lo(c, d), $hi(c, d));
            let (ab, cd) = ($cast(ab), $cast(cd));
            $add($back($lo2(ab, cd)), $back($hi2(ab, cd)))
        })
    }};
}

/// Sums lane by lane, for vectors whose speed matters less.
macro_rules! plain_sums {
    ($T:ty, $lanes:literal) => {
        #[inline(always)]
        fn sums<const N: usize>(vectors: &[Self; N]) -> [$T; MAX_SUMS] {
            let mut sums = [0.0; MAX_SUMS];
            for (sum, vector) in sums.iter_mut().zip(vectors) {
                let mut lanes = [0.0; $lanes];
                vector.store(&mut lanes);
                let mut width = $lanes;
                while width > 1 {
                    width /= 2;
                    for i in 0..width {
                        lanes[i] += lanes[i + width];
                    }
                }
                *sum = lanes[0];
            }
            sums
        }
    };
}

// After the macros that they are written in.
mod avx2;
mod avx512;
mod sse;

use avx2::{F32x8, F64x4};
use avx512::{F32x16, F64x8};
use sse::{F32x4, F64x2};

/// SSE2, which every 64-bit x86 has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sse2(());

/// AVX2 with fused multiply-add.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Avx2(());

/// AVX-512 with its instructions for bytes, words, doublewords and shorter vectors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Avx512(());

impl Sse2 {
    /// Part of the target.
    pub(crate) fn guaranteed() -> Self {
        Self(())
    }
}

impl Simd for Sse2 {
    type F32 = F32x4;
    type F64 = F64x2;

    #[inline(always)]
    fn run<W: Work>(self, work: W) -> W::Output {
        work.run(self)
    }
}

macro_rules! level {
    ($Level:ident, $F32:ty, $F64:ty, $features:literal, $($feature:tt),*) => {
        impl $Level {
            /// The level, if this machine has it.
            pub(crate) fn detect() -> Option<Self> {
                ($(is_x86_feature_detected!($feature))&&*).then_some(Self(()))
            }
        }

        impl Simd for $Level {
            type F32 = $F32;
            type F64 = $F64;

            #[inline(always)]
            fn run<W: Work>(self, work: W) -> W::Output {
                #[target_feature(enable = $features)]
                fn compiled<W: Work>(level: $Level, work: W) -> W::Output {
                    work.run(level)
                }
                // SAFETY: only `detect` makes this value, on a machine with these features.
                unsafe { compiled(self, work) }
            }
        }
    };
}
level!(
    Avx2,
    F32x8,
    F64x4,
    "avx2,fma,bmi1,bmi2,popcnt,lzcnt",
    "avx2",
    "fma",
    "bmi1",
    "bmi2",
    "popcnt",
    "lzcnt"
);
level!(
    Avx512,
    F32x16,
    F64x8,
    "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt",
    "avx512f",
    "avx512vl",
    "avx512bw",
    "avx512dq",
    "avx2",
    "fma",
    "bmi1",
    "bmi2",
    "popcnt",
    "lzcnt"
);

#[inline(always)]
pub(in crate::simd) fn prefetch<U>(value: &U) {
    op!(_mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()));
}

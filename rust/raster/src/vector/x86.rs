//! SSE2, AVX2 with FMA, and AVX-512.
#![allow(unsafe_code)]

use std::arch::x86_64::*;

use super::{EXP2_F32, EXP2_F32_FLOOR, EXP2_F64, MAX_SUMS, Vector, polynomial};

/// Calls an intrinsic that touches no memory.
macro_rules! op {
    ($e:expr) => {
        // SAFETY: the types of this file are only used inside functions compiled for their instructions, which
        // `dispatch` calls after detecting them.
        unsafe { $e }
    };
}

/// Methods that are one intrinsic for every x86 vector.
macro_rules! common {
    ($T:ty, $lanes:literal, $set1:ident, $loadu:ident, $storeu:ident, $add:ident, $sub:ident, $mul:ident, $min:ident, $max:ident) => {
        type Scalar = $T;
        const LANES: usize = $lanes;
        #[inline(always)]
        fn splat(value: $T) -> Self {
            Self(op!($set1(value)))
        }
        #[inline(always)]
        fn load(values: &[$T]) -> Self {
            let values = &values[..$lanes];
            // SAFETY: the slice holds LANES values, and the load may be unaligned.
            Self(unsafe { $loadu(values.as_ptr()) })
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
    () => {
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
            Self::splat(0.0).minus(self.times(a).plus(b))
        }
    };
}

/// 2^x by rounding to the nearest integer, which adding 1.5 · 2^mantissa does and leaves in the low bits.
macro_rules! exp2_by_bits {
    ($coefficients:ident, $lowest:literal, $magic:literal, $mantissa:literal, $to_int:ident, $from_int:ident, $shift:ident, $add:ident) => {
        #[inline(always)]
        fn exp2(self) -> Self {
            let magic = Self::splat($magic);
            let clipped = self.max(Self::splat($lowest));
            let shifted = clipped.plus(magic);
            let fraction = clipped.minus(shifted.minus(magic));
            let power = polynomial(fraction, &$coefficients);
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
    if i < N { vectors[i] } else { V::splat(0.0) }
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

#[derive(Clone, Copy)]
#[allow(unreachable_pub)]
pub struct F32x4(__m128);

impl Vector for F32x4 {
    type Mask = __m128;
    common!(
        f32,
        4,
        _mm_set1_ps,
        _mm_loadu_ps,
        _mm_storeu_ps,
        _mm_add_ps,
        _mm_sub_ps,
        _mm_mul_ps,
        _mm_min_ps,
        _mm_max_ps
    );
    divided!(_mm_div_ps);
    separate!();
    exp2_by_bits!(
        EXP2_F32,
        -126.0,
        12_582_912.0,
        23,
        _mm_castps_si128,
        _mm_castsi128_ps,
        _mm_slli_epi32,
        _mm_add_epi32
    );
    #[inline(always)]
    fn at_least(self, other: Self) -> __m128 {
        op!(_mm_cmpge_ps(self.0, other.0))
    }
    #[inline(always)]
    fn above(self, other: Self) -> __m128 {
        op!(_mm_cmpgt_ps(self.0, other.0))
    }
    #[inline(always)]
    fn both(a: __m128, b: __m128) -> __m128 {
        op!(_mm_and_ps(a, b))
    }
    #[inline(always)]
    fn bits(mask: __m128) -> u32 {
        op!(_mm_movemask_ps(mask) as u32)
    }
    #[inline(always)]
    fn select(self, mask: __m128, other: Self) -> Self {
        Self(op!(_mm_or_ps(
            _mm_and_ps(mask, self.0),
            _mm_andnot_ps(mask, other.0)
        )))
    }
    #[inline(always)]
    fn keep(self, mask: __m128) -> Self {
        Self(op!(_mm_and_ps(mask, self.0)))
    }
    #[inline(always)]
    fn sums<const N: usize>(vectors: &[Self; N]) -> [f32; MAX_SUMS] {
        let mut sums = [0.0; MAX_SUMS];
        for first in (0..N).step_by(4) {
            let four = fold4!(
                vectors,
                first,
                _mm_unpacklo_ps,
                _mm_unpackhi_ps,
                _mm_unpacklo_pd,
                _mm_unpackhi_pd,
                _mm_add_ps,
                _mm_castps_pd,
                _mm_castpd_ps
            );
            Self(four).store(&mut sums[first..]);
        }
        sums
    }
}

#[derive(Clone, Copy)]
#[allow(unreachable_pub)]
pub struct F64x2(__m128d);

impl Vector for F64x2 {
    type Mask = __m128d;
    common!(
        f64,
        2,
        _mm_set1_pd,
        _mm_loadu_pd,
        _mm_storeu_pd,
        _mm_add_pd,
        _mm_sub_pd,
        _mm_mul_pd,
        _mm_min_pd,
        _mm_max_pd
    );
    divided!(_mm_div_pd);
    separate!();
    exp2_by_bits!(
        EXP2_F64,
        -1022.0,
        6_755_399_441_055_744.0,
        52,
        _mm_castpd_si128,
        _mm_castsi128_pd,
        _mm_slli_epi64,
        _mm_add_epi64
    );
    plain_sums!(f64, 2);
    #[inline(always)]
    fn at_least(self, other: Self) -> __m128d {
        op!(_mm_cmpge_pd(self.0, other.0))
    }
    #[inline(always)]
    fn above(self, other: Self) -> __m128d {
        op!(_mm_cmpgt_pd(self.0, other.0))
    }
    #[inline(always)]
    fn both(a: __m128d, b: __m128d) -> __m128d {
        op!(_mm_and_pd(a, b))
    }
    #[inline(always)]
    fn bits(mask: __m128d) -> u32 {
        op!(_mm_movemask_pd(mask) as u32)
    }
    #[inline(always)]
    fn select(self, mask: __m128d, other: Self) -> Self {
        Self(op!(_mm_or_pd(
            _mm_and_pd(mask, self.0),
            _mm_andnot_pd(mask, other.0)
        )))
    }
    #[inline(always)]
    fn keep(self, mask: __m128d) -> Self {
        Self(op!(_mm_and_pd(mask, self.0)))
    }
}

/// Comparisons of 256-bit vectors: a mask is a vector of all-ones and zeros.
macro_rules! masks256 {
    ($Mask:ty, $cmp:ident, $and:ident, $movemask:ident, $blend:ident) => {
        #[inline(always)]
        fn at_least(self, other: Self) -> $Mask {
            op!($cmp::<_CMP_GE_OQ>(self.0, other.0))
        }
        #[inline(always)]
        fn above(self, other: Self) -> $Mask {
            op!($cmp::<_CMP_GT_OQ>(self.0, other.0))
        }
        #[inline(always)]
        fn both(a: $Mask, b: $Mask) -> $Mask {
            op!($and(a, b))
        }
        #[inline(always)]
        fn bits(mask: $Mask) -> u32 {
            op!($movemask(mask) as u32)
        }
        #[inline(always)]
        fn select(self, mask: $Mask, other: Self) -> Self {
            Self(op!($blend(other.0, self.0, mask)))
        }
        #[inline(always)]
        fn keep(self, mask: $Mask) -> Self {
            Self(op!($and(mask, self.0)))
        }
    };
}

#[derive(Clone, Copy)]
#[allow(unreachable_pub)]
pub struct F32x8(__m256);

impl Vector for F32x8 {
    type Mask = __m256;
    common!(
        f32,
        8,
        _mm256_set1_ps,
        _mm256_loadu_ps,
        _mm256_storeu_ps,
        _mm256_add_ps,
        _mm256_sub_ps,
        _mm256_mul_ps,
        _mm256_min_ps,
        _mm256_max_ps
    );
    divided!(_mm256_div_ps);
    fused!(
        _mm256_fmadd_ps,
        _mm256_fmsub_ps,
        _mm256_fnmadd_ps,
        _mm256_fnmsub_ps
    );
    exp2_by_bits!(
        EXP2_F32,
        -126.0,
        12_582_912.0,
        23,
        _mm256_castps_si256,
        _mm256_castsi256_ps,
        _mm256_slli_epi32,
        _mm256_add_epi32
    );
    masks256!(
        __m256,
        _mm256_cmp_ps,
        _mm256_and_ps,
        _mm256_movemask_ps,
        _mm256_blendv_ps
    );
    #[inline(always)]
    fn sums<const N: usize>(vectors: &[Self; N]) -> [f32; MAX_SUMS] {
        let mut sums = [0.0; MAX_SUMS];
        for first in (0..N).step_by(4) {
            let parts = fold4!(
                vectors,
                first,
                _mm256_unpacklo_ps,
                _mm256_unpackhi_ps,
                _mm256_unpacklo_pd,
                _mm256_unpackhi_pd,
                _mm256_add_ps,
                _mm256_castps_pd,
                _mm256_castpd_ps
            );
            let four = op!(_mm_add_ps(
                _mm256_castps256_ps128(parts),
                _mm256_extractf128_ps::<1>(parts)
            ));
            F32x4(four).store(&mut sums[first..]);
        }
        sums
    }
}

#[derive(Clone, Copy)]
#[allow(unreachable_pub)]
pub struct F64x4(__m256d);

impl Vector for F64x4 {
    type Mask = __m256d;
    common!(
        f64,
        4,
        _mm256_set1_pd,
        _mm256_loadu_pd,
        _mm256_storeu_pd,
        _mm256_add_pd,
        _mm256_sub_pd,
        _mm256_mul_pd,
        _mm256_min_pd,
        _mm256_max_pd
    );
    divided!(_mm256_div_pd);
    fused!(
        _mm256_fmadd_pd,
        _mm256_fmsub_pd,
        _mm256_fnmadd_pd,
        _mm256_fnmsub_pd
    );
    exp2_by_bits!(
        EXP2_F64,
        -1022.0,
        6_755_399_441_055_744.0,
        52,
        _mm256_castpd_si256,
        _mm256_castsi256_pd,
        _mm256_slli_epi64,
        _mm256_add_epi64
    );
    masks256!(
        __m256d,
        _mm256_cmp_pd,
        _mm256_and_pd,
        _mm256_movemask_pd,
        _mm256_blendv_pd
    );
    plain_sums!(f64, 4);
}

/// Comparisons of 512-bit vectors: a mask is a mask register.
macro_rules! masks512 {
    ($Mask:ty, $cmp:ident, $mov:ident, $maskz_mov:ident) => {
        type Mask = $Mask;
        #[inline(always)]
        fn at_least(self, other: Self) -> $Mask {
            op!($cmp::<_CMP_GE_OQ>(self.0, other.0))
        }
        #[inline(always)]
        fn above(self, other: Self) -> $Mask {
            op!($cmp::<_CMP_GT_OQ>(self.0, other.0))
        }
        #[inline(always)]
        fn both(a: $Mask, b: $Mask) -> $Mask {
            a & b
        }
        #[inline(always)]
        fn bits(mask: $Mask) -> u32 {
            u32::from(mask)
        }
        #[inline(always)]
        fn select(self, mask: $Mask, other: Self) -> Self {
            Self(op!($mov(other.0, mask, self.0)))
        }
        #[inline(always)]
        fn keep(self, mask: $Mask) -> Self {
            Self(op!($maskz_mov(mask, self.0)))
        }
    };
}

#[derive(Clone, Copy)]
#[allow(unreachable_pub)]
pub struct F32x16(__m512);

/// One vector of what is to be added and one of what it is to be added to: of two pieces that are added, a blend makes
/// one, which runs where a shuffle, the scarce one, does not. Not closures: one that the compiler does not inline would
/// be compiled without these instructions.
impl F32x16 {
    #[inline(always)]
    fn by_8(self, other: Self) -> Self {
        Self(op!(_mm512_add_ps(
            _mm512_mask_blend_ps(0xFF00, self.0, other.0),
            _mm512_shuffle_f32x4::<0b01_00_11_10>(self.0, other.0)
        )))
    }

    #[inline(always)]
    fn by_4(self, other: Self) -> Self {
        Self(op!(_mm512_add_ps(
            _mm512_mask_blend_ps(0xF0F0, self.0, other.0),
            _mm512_permutex2var_ps(
                self.0,
                _mm512_setr_epi32(4, 5, 6, 7, 16, 17, 18, 19, 12, 13, 14, 15, 24, 25, 26, 27),
                other.0
            )
        )))
    }

    #[inline(always)]
    fn by_2(self, other: Self) -> Self {
        Self(op!(_mm512_add_ps(
            _mm512_mask_blend_ps(0xCCCC, self.0, other.0),
            _mm512_shuffle_ps::<0b01_00_11_10>(self.0, other.0)
        )))
    }

    #[inline(always)]
    fn by_1(self, other: Self) -> Self {
        Self(op!(_mm512_add_ps(
            _mm512_mask_blend_ps(0xAAAA, self.0, other.0),
            _mm512_permutex2var_ps(
                self.0,
                _mm512_setr_epi32(1, 16, 3, 18, 5, 20, 7, 22, 9, 24, 11, 26, 13, 28, 15, 30),
                other.0
            )
        )))
    }
}

impl Vector for F32x16 {
    common!(
        f32,
        16,
        _mm512_set1_ps,
        _mm512_loadu_ps,
        _mm512_storeu_ps,
        _mm512_add_ps,
        _mm512_sub_ps,
        _mm512_mul_ps,
        _mm512_min_ps,
        _mm512_max_ps
    );
    #[inline(always)]
    fn over(self, other: Self) -> Self {
        // A quotient from a reciprocal of 14 bits, corrected once by what it leaves: the division unit takes twice as
        // long.
        let reciprocal = Self(op!(_mm512_rcp14_ps(other.0)));
        let quotient = self.times(reciprocal);
        quotient.times_from(other, self).times_plus(reciprocal, quotient)
    }
    fused!(
        _mm512_fmadd_ps,
        _mm512_fmsub_ps,
        _mm512_fnmadd_ps,
        _mm512_fnmsub_ps
    );
    masks512!(
        __mmask16,
        _mm512_cmp_ps_mask,
        _mm512_mask_mov_ps,
        _mm512_maskz_mov_ps
    );
    #[inline(always)]
    fn exp2(self) -> Self {
        // Two instructions, the fractional part and the scaling by 2^floor, stand for the five of the bit trick.
        let fraction = Self(op!(_mm512_reduce_ps::<{ _MM_FROUND_TO_NEG_INF }>(self.0)));
        let power = polynomial(fraction, &EXP2_F32_FLOOR);
        Self(op!(_mm512_scalef_ps(power.0, self.0)))
    }
    #[inline(always)]
    fn sums<const N: usize>(vectors: &[Self; N]) -> [f32; MAX_SUMS] {
        // Two vectors become one, half as many lanes for each, until one is left.
        let mut pieces: [Self; MAX_SUMS] = [Self::splat(0.0); MAX_SUMS];
        pieces[..N].copy_from_slice(vectors);
        for i in 0..8 {
            pieces[i] = pieces[2 * i].by_8(pieces[2 * i + 1]);
        }
        for i in 0..4 {
            pieces[i] = pieces[2 * i].by_4(pieces[2 * i + 1]);
        }
        for i in 0..2 {
            pieces[i] = pieces[2 * i].by_2(pieces[2 * i + 1]);
        }
        let all = pieces[0].by_1(pieces[1]).0;
        // Each vector's sum is now in the lane that its number, its four bits backwards, tells.
        let order = op!(_mm512_setr_epi32(
            0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15
        ));
        let all = op!(_mm512_permutexvar_ps(order, all));
        let mut sums = [0.0; MAX_SUMS];
        Self(all).store(&mut sums);
        sums
    }
}

#[derive(Clone, Copy)]
#[allow(unreachable_pub)]
pub struct F64x8(__m512d);

impl Vector for F64x8 {
    common!(
        f64,
        8,
        _mm512_set1_pd,
        _mm512_loadu_pd,
        _mm512_storeu_pd,
        _mm512_add_pd,
        _mm512_sub_pd,
        _mm512_mul_pd,
        _mm512_min_pd,
        _mm512_max_pd
    );
    divided!(_mm512_div_pd);
    fused!(
        _mm512_fmadd_pd,
        _mm512_fmsub_pd,
        _mm512_fnmadd_pd,
        _mm512_fnmsub_pd
    );
    masks512!(
        __mmask8,
        _mm512_cmp_pd_mask,
        _mm512_mask_mov_pd,
        _mm512_maskz_mov_pd
    );
    exp2_by_bits!(
        EXP2_F64,
        -1022.0,
        6_755_399_441_055_744.0,
        52,
        _mm512_castpd_si512,
        _mm512_castsi512_pd,
        _mm512_slli_epi64,
        _mm512_add_epi64
    );
    plain_sums!(f64, 8);
}

#[inline(always)]
pub(super) fn prefetch<U>(value: &U) {
    op!(_mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()));
}

/// Bit `b` of `masks[i]` becomes bit `i` of the `b`-th word: 16 masks at a time, their bytes apart, a bit per step.
#[inline(always)]
pub(super) fn transpose_bits(masks: &[u16; 64]) -> [u64; 16] {
    let mut words = [0u64; 16];
    for (quarter, masks) in masks.chunks_exact(16).enumerate() {
        // SAFETY: SSE2 is part of x86-64; both loads are of 8 of the chunk's 16 masks and may be unaligned.
        unsafe {
            let a = _mm_loadu_si128(masks.as_ptr().cast());
            let b = _mm_loadu_si128(masks.as_ptr().add(8).cast());
            let low = _mm_set1_epi16(0xFF);
            let mut bytes = [
                _mm_packus_epi16(_mm_and_si128(a, low), _mm_and_si128(b, low)),
                _mm_packus_epi16(_mm_srli_epi16::<8>(a), _mm_srli_epi16::<8>(b)),
            ];
            for (half, bytes) in bytes.iter_mut().enumerate() {
                for bit in (0..8).rev() {
                    let sixteen = _mm_movemask_epi8(*bytes) as u64;
                    words[half * 8 + bit] |= sixteen << (quarter * 16);
                    *bytes = _mm_add_epi8(*bytes, *bytes);
                }
            }
        }
    }
    words
}

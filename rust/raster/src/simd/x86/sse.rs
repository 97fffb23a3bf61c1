//! SSE2, which every x86-64 has.

use std::arch::x86_64::*;

use super::nth;
use crate::simd::vector::{EXP2_F32, EXP2_F64, MAX_SUMS, Vector, exp2_f32, polynomial};

#[derive(Clone, Copy)]
pub(crate) struct F32x4(pub(super) __m128);

impl Vector for F32x4 {
    type Mask = __m128;
    common!(
        Sse2,
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
    separate!(_mm_set1_ps);
    exp2_by_bits!(
        _mm_set1_ps,
        exp2_f32::<DEGREE>(&EXP2_F32),
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
pub(crate) struct F64x2(__m128d);

impl Vector for F64x2 {
    type Mask = __m128d;
    common!(
        Sse2,
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
    separate!(_mm_set1_pd);
    exp2_by_bits!(
        _mm_set1_pd,
        &EXP2_F64,
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

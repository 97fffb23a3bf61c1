//! AVX2 with FMA.

use std::arch::x86_64::*;

use super::nth;
use super::sse::F32x4;
use crate::simd::vector::{EXP2_F32, EXP2_F64, MAX_SUMS, Vector, exp2_f32, polynomial};

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
pub(crate) struct F32x8(__m256);

impl Vector for F32x8 {
    type Mask = __m256;
    common!(
        Avx2,
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
        _mm256_set1_ps,
        exp2_f32::<DEGREE>(&EXP2_F32),
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
pub(crate) struct F64x4(__m256d);

impl Vector for F64x4 {
    type Mask = __m256d;
    common!(
        Avx2,
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
        _mm256_set1_pd,
        &EXP2_F64,
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

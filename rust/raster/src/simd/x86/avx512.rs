//! AVX-512.

use std::arch::x86_64::*;

use crate::simd::vector::{EXP2_F32_FLOOR, EXP2_F64, MAX_SUMS, Vector, exp2_f32, polynomial};

/// Comparisons of 512-bit vectors: a mask is a mask register.
macro_rules! masks512 {
    ($Mask:ty, $cmp:ident, $mask_cmp:ident, $mov:ident, $maskz_mov:ident) => {
        type Mask = $Mask;
        #[inline(always)]
        fn at_least(self, other: Self) -> $Mask {
            op!($cmp::<_CMP_GE_OQ>(self.0, other.0))
        }
        #[inline(always)]
        fn at_least_where(self, other: Self, mask: $Mask) -> $Mask {
            op!($mask_cmp::<_CMP_GE_OQ>(mask, self.0, other.0))
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
pub(crate) struct F32x16(__m512);

/// Steps of a sum over lanes: two vectors become one with half as many lanes for each. Of the two vectors that are added,
/// one is made by a blend and not by a shuffle, because only one execution port shuffles. These are functions and not
/// closures, because a closure that is not inlined would be compiled without AVX-512.
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
        Avx512,
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
    // A corrected reciprocal takes three instructions more, and the backward pass is short of units to run them on.
    divided!(_mm512_div_ps);
    fused!(
        _mm512_fmadd_ps,
        _mm512_fmsub_ps,
        _mm512_fnmadd_ps,
        _mm512_fnmsub_ps
    );
    masks512!(
        __mmask16,
        _mm512_cmp_ps_mask,
        _mm512_mask_cmp_ps_mask,
        _mm512_mask_mov_ps,
        _mm512_maskz_mov_ps
    );
    #[inline(always)]
    fn exp2<const DEGREE: usize>(self) -> Self {
        // Two instructions, the fractional part and the scaling by 2^floor, stand for the five of the bit trick.
        let fraction = Self(op!(_mm512_reduce_ps::<{ _MM_FROUND_TO_NEG_INF }>(self.0)));
        let power = polynomial(fraction, exp2_f32::<DEGREE>(&EXP2_F32_FLOOR));
        Self(op!(_mm512_scalef_ps(power.0, self.0)))
    }
    #[inline(always)]
    fn sums<const N: usize>(vectors: &[Self; N]) -> [f32; MAX_SUMS] {
        const { assert!(N > 0) };
        let mut pieces = [Self(op!(_mm512_setzero_ps())); MAX_SUMS];
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
        // The sum of vector i is now in the lane whose number is i with its four bits reversed.
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
pub(crate) struct F64x8(__m512d);

impl Vector for F64x8 {
    common!(
        Avx512,
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
        _mm512_mask_cmp_pd_mask,
        _mm512_mask_mov_pd,
        _mm512_maskz_mov_pd
    );
    exp2_by_bits!(
        _mm512_set1_pd,
        &EXP2_F64,
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

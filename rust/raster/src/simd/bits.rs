//! Prefetching, and bit matrices.

#[cfg(target_arch = "x86_64")]
use crate::simd::x86;

/// Starts to bring a value into the first cache; none if there is no such value.
#[inline(always)]
pub(crate) fn prefetch<U>(values: &[U], index: usize) {
    #[cfg(target_arch = "x86_64")]
    if let Some(value) = values.get(index) {
        x86::prefetch(value);
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (values, index);
}

/// Bit `b` of `masks[i]` becomes bit `i` of the `b`-th word.
#[inline(always)]
pub(crate) fn transpose_bits(masks: &[u16; 64]) -> [u64; 16] {
    #[cfg(target_arch = "x86_64")]
    return x86::transpose_bits(masks);
    #[cfg(not(target_arch = "x86_64"))]
    transpose_bits_one_by_one(masks)
}

#[cfg(any(test, not(target_arch = "x86_64")))]
pub(super) fn transpose_bits_one_by_one(masks: &[u16; 64]) -> [u64; 16] {
    std::array::from_fn(|b| {
        let bits = masks
            .iter()
            .zip(0..)
            .map(|(mask, i)| u64::from(mask >> b & 1) << i);
        bits.fold(0, |word, bit| word | bit)
    })
}

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

/// Transposes a matrix of bits: bit `b` of word `i` becomes bit `i` of word `b`. Quarters swap places, then the quarters
/// of each, down to single bits.
#[inline(always)]
pub(crate) fn transpose_bits(words: &mut [u64; 64]) {
    let mut kept = u64::MAX;
    let mut size = 32;
    while size > 0 {
        kept ^= kept << size;
        for pairs in words.chunks_exact_mut(2 * size) {
            let (upper, lower) = pairs.split_at_mut(size);
            for (upper, lower) in upper.iter_mut().zip(lower) {
                let swapped = (*upper >> size ^ *lower) & kept;
                *upper ^= swapped << size;
                *lower ^= swapped;
            }
        }
        size /= 2;
    }
}

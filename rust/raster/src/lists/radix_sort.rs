//! A stable radix sort of (key, value) pairs. It knows nothing of splats.

use crate::math::radix_key::{BUCKETS, MOST_BITS, RadixKey};
use crate::memory::pool::{bytes_of, filled, stale};

/// What a sort needs besides the pairs; it can be used again.
#[derive(Debug, Default)]
pub(crate) struct SortScratch<K> {
    counts: Vec<[u32; BUCKETS]>,
    other: Vec<(K, u32)>,
}

impl<K> SortScratch<K> {
    pub(crate) fn bytes(&self) -> usize {
        bytes_of(&self.counts) + bytes_of(&self.other)
    }

    /// Memory for pairs, between sorts.
    pub(crate) fn spare(&mut self) -> &mut Vec<(K, u32)> {
        &mut self.other
    }
}

/// Sorts `pairs` by key; equal keys keep their order. Every bit of the key counts.
///
/// It takes one pass per twelve bits of the difference between the greatest and the least key.
pub fn radix_sort<K: RadixKey>(pairs: &mut Vec<(K, u32)>) {
    radix_sort_with(pairs, &mut SortScratch::default());
}

/// [`radix_sort`] in given memory.
pub(crate) fn radix_sort_with<K: RadixKey>(pairs: &mut Vec<(K, u32)>, scratch: &mut SortScratch<K>) {
    let (Some(least), Some(most)) = (
        pairs.iter().map(|pair| pair.0).min(),
        pairs.iter().map(|pair| pair.0).max(),
    ) else {
        return;
    };
    // As few buckets as the passes allow: they compete with the pairs for the cache.
    let bits = most.bits(least);
    let digits = bits.div_ceil(MOST_BITS);
    let width = bits.div_ceil(digits.max(1));
    let buckets = 1 << width;
    let digit_of = |key: K, digit: usize| key.digit(least, digit as u32 * width) & (buckets - 1);
    let counts = filled(&mut scratch.counts, digits as usize, [0; BUCKETS]);
    for &(key, _) in pairs.iter() {
        for (digit, count) in counts.iter_mut().enumerate() {
            count[digit_of(key, digit)] += 1;
        }
    }
    stale(&mut scratch.other, pairs.len());
    for (digit, starts) in counts.iter_mut().enumerate() {
        let mut start = 0;
        for slot in &mut starts[..buckets] {
            let count = *slot;
            *slot = start;
            start += count;
        }
        for &pair in pairs.iter() {
            let slot = &mut starts[digit_of(pair.0, digit)];
            scratch.other[*slot as usize] = pair;
            *slot += 1;
        }
        std::mem::swap(pairs, &mut scratch.other);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_are_sorted_and_equal_keys_keep_their_order() {
        let keys = (0..200u64).map(|i| i.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        for shift in [0, 20, 40, 60] {
            let mut pairs: Vec<(u64, u32)> = keys.clone().map(|key| key >> shift).zip(0..).collect();
            let mut expected = pairs.clone();
            expected.sort_by_key(|&(key, _)| key);
            radix_sort(&mut pairs);
            assert_eq!(pairs, expected);
        }
    }
}

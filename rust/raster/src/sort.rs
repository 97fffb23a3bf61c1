//! A stable radix sort of (key, value) pairs. It knows nothing of splats.

use std::fmt::Debug;

/// An unsigned integer that a radix sort can take digits of.
pub trait RadixKey: Copy + Debug + Default + Ord + Send + Sync + 'static {
    /// `BUCKETS` values, from bit `shift` on, of what a key exceeds the least key by.
    fn digit(self, least: Self, shift: u32) -> usize;
    /// How many bits that has.
    fn bits(self, least: Self) -> u32;
}

/// Depths of one scene often lie within a factor of four, which is 24 bits of a float: two passes.
const MOST_BITS: u32 = 12;
const BUCKETS: usize = 1 << MOST_BITS;

macro_rules! radix_key {
    ($T:ty) => {
        impl RadixKey for $T {
            #[inline(always)]
            fn digit(self, least: Self, shift: u32) -> usize {
                ((self - least) >> shift) as usize & (BUCKETS - 1)
            }
            fn bits(self, least: Self) -> u32 {
                <$T>::BITS - (self - least).leading_zeros()
            }
        }
    };
}
radix_key!(u32);
radix_key!(u64);

/// What a sort needs besides the pairs; it can be used again.
#[derive(Debug, Default)]
pub(crate) struct SortScratch<K> {
    counts: Vec<[u32; BUCKETS]>,
    other: Vec<(K, u32)>,
}

impl<K> SortScratch<K> {
    pub(crate) fn bytes(&self) -> usize {
        crate::pool::bytes_of(&self.counts) + crate::pool::bytes_of(&self.other)
    }
}

/// Sorts `pairs` by key; equal keys keep their order. Every bit of the key counts.
///
/// It takes as many passes as the difference of the greatest and the least key has dozens of bits.
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
    // No more buckets than it takes: they compete with the pairs for the cache.
    let bits = most.bits(least);
    let digits = bits.div_ceil(MOST_BITS);
    let width = bits.div_ceil(digits.max(1));
    let buckets = 1 << width;
    let digit_of = |key: K, digit: usize| key.digit(least, digit as u32 * width) & (buckets - 1);
    let counts = crate::pool::filled(&mut scratch.counts, digits as usize, [0; BUCKETS]);
    for &(key, _) in pairs.iter() {
        for (digit, count) in counts.iter_mut().enumerate() {
            count[digit_of(key, digit)] += 1;
        }
    }
    crate::pool::stale(&mut scratch.other, pairs.len());
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

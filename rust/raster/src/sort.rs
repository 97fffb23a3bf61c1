//! A stable radix sort of (key, value) pairs. It knows nothing of splats.

use std::fmt::Debug;

/// An unsigned integer that a radix sort can take digits of.
pub trait RadixKey: Copy + Debug + Default + Ord + Send + Sync + 'static {
    /// Digits of `DIGIT_BITS` bits in a key.
    const DIGITS: u32;
    /// Digit `index`, the least significant first.
    fn digit(self, index: u32) -> usize;
}

/// Three passes cover 32 bits, six cover 64.
const DIGIT_BITS: u32 = 11;
const BUCKETS: usize = 1 << DIGIT_BITS;

macro_rules! radix_key {
    ($T:ty) => {
        impl RadixKey for $T {
            const DIGITS: u32 = <$T>::BITS.div_ceil(DIGIT_BITS);
            #[inline(always)]
            fn digit(self, index: u32) -> usize {
                ((self >> (index * DIGIT_BITS)) as usize) & (BUCKETS - 1)
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
/// A digit that all keys share costs no pass, which is usual for the high bits of depths.
pub fn radix_sort<K: RadixKey>(pairs: &mut Vec<(K, u32)>) {
    radix_sort_with(pairs, &mut SortScratch::default());
}

/// [`radix_sort`] in given memory.
pub(crate) fn radix_sort_with<K: RadixKey>(pairs: &mut Vec<(K, u32)>, scratch: &mut SortScratch<K>) {
    let counts = crate::pool::filled(&mut scratch.counts, K::DIGITS as usize, [0; BUCKETS]);
    for &(key, _) in pairs.iter() {
        for (digit, count) in counts.iter_mut().enumerate() {
            count[key.digit(digit as u32)] += 1;
        }
    }
    crate::pool::stale(&mut scratch.other, pairs.len());
    for (digit, starts) in counts.iter_mut().enumerate() {
        if starts.iter().any(|&count| count as usize == pairs.len()) {
            continue;
        }
        let mut start = 0;
        for slot in starts.iter_mut() {
            let count = *slot;
            *slot = start;
            start += count;
        }
        for &pair in pairs.iter() {
            let slot = &mut starts[pair.0.digit(digit as u32)];
            scratch.other[*slot as usize] = pair;
            *slot += 1;
        }
        std::mem::swap(pairs, &mut scratch.other);
    }
}

//! Unsigned integers that a radix sort can take digits of.

use std::fmt::Debug;

/// An unsigned integer that a radix sort can take digits of.
pub trait RadixKey: Copy + Debug + Default + Ord + Send + Sync + 'static {
    /// `BUCKETS` values, from bit `shift` on, of what a key exceeds the least key by.
    fn digit(self, least: Self, shift: u32) -> usize;
    /// How many bits that has.
    fn bits(self, least: Self) -> u32;
}

/// Depths of one scene often lie within a factor of four, which is 24 bits of a float: two passes.
pub(crate) const MOST_BITS: u32 = 12;
pub(crate) const BUCKETS: usize = 1 << MOST_BITS;

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

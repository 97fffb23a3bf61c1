//! Vectors of floats, one type per instruction set, behind one trait: what the kernels are written in.
//!
//! Methods are safe to call because a type is only ever named where its instructions are known to exist: `dispatch`
//! enters a kernel with it after detecting them, inside a function compiled for them. Every method is inlined there.

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(any(test, not(any(target_arch = "x86_64", target_arch = "aarch64"))))]
pub(crate) mod portable;
#[cfg(test)]
mod tests;
#[cfg(target_arch = "x86_64")]
mod x86;

pub(crate) mod level;
pub mod peak;
pub(crate) mod vector;

use crate::math::real::Real;
use crate::simd::vector::Vector;

/// The vector of each instruction set for a scalar.
#[allow(unreachable_pub, missing_docs)]
pub trait Vectors: Real {
    /// What the target guarantees.
    type Baseline: Vector<Scalar = Self>;
    #[cfg(target_arch = "x86_64")]
    type Avx2: Vector<Scalar = Self>;
    #[cfg(target_arch = "x86_64")]
    type Avx512: Vector<Scalar = Self>;
}

macro_rules! vectors {
    ($T:ty, $baseline:ty, $avx2:ty, $avx512:ty) => {
        impl Vectors for $T {
            type Baseline = $baseline;
            #[cfg(target_arch = "x86_64")]
            type Avx2 = $avx2;
            #[cfg(target_arch = "x86_64")]
            type Avx512 = $avx512;
        }
    };
}
#[cfg(target_arch = "x86_64")]
vectors!(f32, x86::F32x4, x86::F32x8, x86::F32x16);
#[cfg(target_arch = "x86_64")]
vectors!(f64, x86::F64x2, x86::F64x4, x86::F64x8);
#[cfg(target_arch = "aarch64")]
vectors!(f32, neon::F32x4, (), ());
#[cfg(target_arch = "aarch64")]
vectors!(f64, neon::F64x2, (), ());
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
vectors!(f32, portable::Array<f32>, (), ());
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
vectors!(f64, portable::Array<f64>, (), ());

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
fn transpose_bits_one_by_one(masks: &[u16; 64]) -> [u64; 16] {
    std::array::from_fn(|b| {
        let bits = masks
            .iter()
            .zip(0..)
            .map(|(mask, i)| u64::from(mask >> b & 1) << i);
        bits.fold(0, |word, bit| word | bit)
    })
}

//! Vectors of floats, one type per instruction set, behind one trait that the kernels are written in, and the choice of
//! the instruction set at run time.

mod bits;
pub(crate) mod level;
#[cfg(target_arch = "aarch64")]
mod neon;
pub mod peak;
#[cfg(any(test, not(any(target_arch = "x86_64", target_arch = "aarch64"))))]
pub(crate) mod portable;

#[cfg(test)]
mod tests;
pub(crate) mod vector;
#[cfg(target_arch = "x86_64")]
mod x86;

pub(crate) use bits::{prefetch, transpose_bits};

use crate::math::real::Real;
use crate::simd::level::Simd;
use crate::simd::vector::Vector;

/// A scalar that every level has vectors of.
#[allow(unreachable_pub)]
pub trait Vectors: Real {
    /// The level's vector of this scalar.
    type In<S: Simd>: Vector<Scalar = Self, Level = S>;
}

impl Vectors for f32 {
    type In<S: Simd> = S::F32;
}

impl Vectors for f64 {
    type In<S: Simd> = S::F64;
}

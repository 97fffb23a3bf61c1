//! CPU feature levels: which of them this machine has, and how work is compiled for each.
//!
//! Work is written once, over the trait [`Simd`], and compiled once per level. A level is a value that only exists on a
//! machine with its features, and a vector can only be made with one, so safe code cannot reach an instruction that the
//! CPU does not have.

use std::fmt::Debug;
use std::sync::OnceLock;

use crate::error::RasterError;
#[cfg(target_arch = "aarch64")]
pub(crate) use crate::simd::neon::Neon as Baseline;
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
pub(crate) use crate::simd::portable::Portable as Baseline;
use crate::simd::vector::Vector;
#[cfg(target_arch = "x86_64")]
pub(crate) use crate::simd::x86::{Avx2, Avx512, Sse2 as Baseline};

/// The environment variable that lowers the level.
const VARIABLE: &str = "BIGS_RASTER_SIMD";

/// A CPU feature level, as proof that this machine has it.
#[allow(unreachable_pub)]
pub trait Simd: Copy + Debug + Send + Sync + 'static {
    /// Its vector of `f32`.
    type F32: Vector<Scalar = f32, Level = Self>;
    /// Its vector of `f64`.
    type F64: Vector<Scalar = f64, Level = Self>;

    /// Does the work with everything in it compiled for this level.
    fn run<W: Work>(self, work: W) -> W::Output;
}

/// Work that is compiled once per level. Functions that it calls must be inlined into `run`, or they are compiled for the
/// baseline.
#[allow(unreachable_pub, missing_docs)]
pub trait Work {
    type Output;
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// One of the levels that the kernels are compiled for.
#[derive(Clone, Copy, Debug)]
#[allow(private_interfaces, unreachable_pub)]
pub enum SimdLevel {
    /// What the target guarantees: SSE2 on x86-64, without fused multiply-add; NEON on ARM; else no vectors.
    Baseline(Baseline),
    /// 256-bit vectors with fused multiply-add.
    #[cfg(target_arch = "x86_64")]
    Avx2(Avx2),
    /// 512-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512),
}

impl SimdLevel {
    /// The best level of this machine, or the one that `BIGS_RASTER_SIMD` names.
    ///
    /// # Errors
    /// `BIGS_RASTER_SIMD` names a level that there is not, or that this machine does not have.
    #[allow(unreachable_pub)]
    pub fn chosen() -> Result<Self, RasterError> {
        static LEVEL: OnceLock<Result<SimdLevel, RasterError>> = OnceLock::new();
        let choose =
            || Self::named(std::env::var_os(VARIABLE).map(|name| name.to_string_lossy().into_owned()));
        LEVEL.get_or_init(choose).clone()
    }

    /// The level with this name, or the best of this machine for none or an empty one.
    fn named(name: Option<String>) -> Result<Self, RasterError> {
        let name = name.unwrap_or_default();
        let levels = Self::available();
        match levels
            .iter()
            .find(|level| name.is_empty() || level.name() == name)
        {
            Some(level) => Ok(*level),
            None => Err(RasterError::BadSimdLevel {
                found: name,
                available: levels.into_iter().map(Self::name).collect(),
            }),
        }
    }

    /// What it is called in `BIGS_RASTER_SIMD`.
    pub(crate) fn name(self) -> &'static str {
        match self {
            #[cfg(target_arch = "aarch64")]
            Self::Baseline(_) => "neon",
            #[cfg(not(target_arch = "aarch64"))]
            Self::Baseline(_) => "baseline",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(_) => "avx2",
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => "avx512",
        }
    }

    /// Every level of this machine, the best first.
    pub(crate) fn available() -> Vec<Self> {
        let mut levels = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            levels.extend(Avx512::detect().map(Self::Avx512));
            levels.extend(Avx2::detect().map(Self::Avx2));
        }
        levels.push(Self::Baseline(Baseline::guaranteed()));
        levels
    }

    /// Does the work at this level.
    #[inline(always)]
    #[allow(unreachable_pub)]
    pub fn run<W: Work>(self, work: W) -> W::Output {
        match self {
            Self::Baseline(simd) => simd.run(work),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(simd) => simd.run(work),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(simd) => simd.run(work),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_found_by_their_exact_names() {
        let all = SimdLevel::available();
        let best = SimdLevel::named(None).unwrap().name();
        assert_eq!(best, all[0].name());
        assert_eq!(SimdLevel::named(Some(String::new())).unwrap().name(), best);
        for level in &all {
            let found = SimdLevel::named(Some(level.name().to_string())).unwrap();
            assert_eq!(found.name(), level.name());
        }
        for wrong in ["AVX2", "avx", "sse4", " baseline"] {
            let message = SimdLevel::named(Some(wrong.to_string())).unwrap_err().to_string();
            let names: Vec<&str> = all.iter().map(|level| level.name()).collect();
            assert_eq!(
                message,
                format!(
                    "BIGS_RASTER_SIMD: expected one of {}, found '{wrong}'",
                    names.join(", ")
                )
            );
        }
    }
}

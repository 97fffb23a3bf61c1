//! Compiles the loops that turn gradients of tiles into gradients of Gaussians once per CPU feature level and picks the
//! best at run time.
//!
//! The arithmetic is the same at every level, down to the bit: these loops fuse no multiplication with an addition.

use crate::backproject::sum_tiles::{ChunkSlots, ScreenGradients, gather_chunk};
use crate::input::gaussians::Gaussians;
use crate::math::real::Real;
use crate::project::packet::{ChunkGradients, vjp_chunk};
use crate::project::splat::Lens;
use crate::simd::level::SimdLevel;

macro_rules! compiled_for {
    ($module:ident, $features:literal) => {
        #[cfg(target_arch = "x86_64")]
        mod $module {
            use super::*;

            #[target_feature(enable = $features)]
            pub(super) fn gather<T: Real>(
                from: &ChunkSlots<'_, T>,
                out: ScreenGradients<'_, T>,
                v: &mut ChunkGradients<T>,
            ) {
                gather_chunk(from, out, v);
            }

            #[target_feature(enable = $features)]
            pub(super) fn vjp<T: Real, const ANTIALIASED: bool, const CAMERA: bool>(
                gaussians: &Gaussians<'_, T>,
                first: usize,
                lens: &Lens<T>,
                chunk: &mut ChunkGradients<T>,
            ) {
                vjp_chunk::<T, ANTIALIASED, CAMERA>(gaussians, first, lens, chunk);
            }
        }
    };
}
compiled_for!(avx2, "avx2,fma,bmi1,bmi2,popcnt,lzcnt");
compiled_for!(
    avx512,
    "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt"
);

#[allow(unsafe_code)]
fn vjp_level<T: Real, const ANTIALIASED: bool, const CAMERA: bool>(
    level: SimdLevel,
    gaussians: &Gaussians<'_, T>,
    first: usize,
    lens: &Lens<T>,
    chunk: &mut ChunkGradients<T>,
) {
    match level {
        // SAFETY: a level other than the baseline comes from `available`, which has detected its features.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { avx2::vjp::<T, ANTIALIASED, CAMERA>(gaussians, first, lens, chunk) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe { avx512::vjp::<T, ANTIALIASED, CAMERA>(gaussians, first, lens, chunk) },
        _ => vjp_chunk::<T, ANTIALIASED, CAMERA>(gaussians, first, lens, chunk),
    }
}

/// [`gather_chunk`] on this machine.
#[allow(unsafe_code)]
pub(crate) fn gather<T: Real>(
    level: SimdLevel,
    from: &ChunkSlots<'_, T>,
    out: ScreenGradients<'_, T>,
    v: &mut ChunkGradients<T>,
) {
    match level {
        // SAFETY: a level other than the baseline comes from `available`, which has detected its features.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { avx2::gather(from, out, v) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe { avx512::gather(from, out, v) },
        _ => gather_chunk(from, out, v),
    }
}

/// [`vjp_chunk`] on this machine; the camera's part only if asked for.
pub(crate) fn vjp<T: Real>(
    level: SimdLevel,
    gaussians: &Gaussians<'_, T>,
    first: usize,
    lens: &Lens<T>,
    camera: bool,
    chunk: &mut ChunkGradients<T>,
) {
    match (lens.antialiased(), camera) {
        (false, false) => vjp_level::<T, false, false>(level, gaussians, first, lens, chunk),
        (false, true) => vjp_level::<T, false, true>(level, gaussians, first, lens, chunk),
        (true, false) => vjp_level::<T, true, false>(level, gaussians, first, lens, chunk),
        (true, true) => vjp_level::<T, true, true>(level, gaussians, first, lens, chunk),
    }
}

//! Compiles the loops of `packet` once per CPU feature level and picks the best at run time.
//!
//! The arithmetic is the same at every level, down to the bit: these loops fuse no multiplication with an addition.

use crate::input::gaussians::Gaussians;
use crate::math::real::Real;
use crate::project::packet::{ChunkSplats, project_chunk};
use crate::project::splat::Lens;
use crate::project::tiles::TileGrid;
use crate::simd::level::SimdLevel;

macro_rules! compiled_for {
    ($module:ident, $features:literal) => {
        #[cfg(target_arch = "x86_64")]
        mod $module {
            use super::*;

            #[target_feature(enable = $features)]
            pub(super) fn project<T: Real, const ANTIALIASED: bool>(
                gaussians: &Gaussians<'_, T>,
                first: usize,
                lens: &Lens<T>,
                grid: &TileGrid,
                wanted: Option<&[bool]>,
                out: ChunkSplats<'_, T>,
            ) {
                project_chunk::<T, ANTIALIASED>(gaussians, first, lens, grid, wanted, out);
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
fn project_level<T: Real, const ANTIALIASED: bool>(
    level: SimdLevel,
    gaussians: &Gaussians<'_, T>,
    first: usize,
    lens: &Lens<T>,
    grid: &TileGrid,
    wanted: Option<&[bool]>,
    out: ChunkSplats<'_, T>,
) {
    match level {
        // SAFETY: a level other than the baseline comes from `available`, which has detected its features.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe {
            avx2::project::<T, ANTIALIASED>(gaussians, first, lens, grid, wanted, out)
        },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe {
            avx512::project::<T, ANTIALIASED>(gaussians, first, lens, grid, wanted, out);
        },
        _ => project_chunk::<T, ANTIALIASED>(gaussians, first, lens, grid, wanted, out),
    }
}

/// [`project_chunk`] on this machine.
pub(crate) fn project<T: Real>(
    level: SimdLevel,
    gaussians: &Gaussians<'_, T>,
    first: usize,
    lens: &Lens<T>,
    grid: &TileGrid,
    wanted: Option<&[bool]>,
    out: ChunkSplats<'_, T>,
) {
    if lens.antialiased() {
        project_level::<T, true>(level, gaussians, first, lens, grid, wanted, out);
    } else {
        project_level::<T, false>(level, gaussians, first, lens, grid, wanted, out);
    }
}

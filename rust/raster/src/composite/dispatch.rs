//! Compiles the kernels once per CPU feature level and picks the best at run time.
//!
//! Calling a function compiled for features that were detected before is what it needs `unsafe` for.

use crate::composite::kernel::{
    Lanes, MAX_BLOCKS, MAX_CHANNELS, TileCotangents, TileImage, TilePlane, TileTask, backward_tile,
    forward_tile, median_tile,
};
use crate::simd::Vectors;
use crate::simd::level::SimdLevel;
use crate::simd::vector::FINEST;

/// Channels that the kernel for the last group may have more than are left: no number has a kernel of its own in
/// [`forward_rough`].
pub(crate) const SPARE_CHANNELS: usize = MAX_CHANNELS - 4;

macro_rules! compiled_for {
    ($module:ident, $Vector:ident, $features:literal) => {
        #[cfg(target_arch = "x86_64")]
        mod $module {
            use super::*;

            #[target_feature(enable = $features)]
            pub(super) fn forward<T: Vectors, const K: usize, const DEGREE: usize>(
                task: &TileTask<'_, T>,
                open: &[u16; MAX_BLOCKS],
                out: TileImage<'_, T>,
            ) {
                forward_tile::<<T as Vectors>::$Vector, K, DEGREE>(task, open, out);
            }

            #[target_feature(enable = $features)]
            pub(super) fn backward<T: Vectors, const K: usize, const ABSOLUTE: bool, const DEGREE: usize>(
                task: &TileTask<'_, T>,
                pixels: &TileCotangents<'_, T>,
                slots: &mut [T],
                size: usize,
            ) {
                backward_tile::<<T as Vectors>::$Vector, K, ABSOLUTE, DEGREE>(task, pixels, slots, size);
            }

            #[target_feature(enable = $features)]
            pub(super) fn median<T: Vectors>(
                task: &TileTask<'_, T>,
                masks: &[u16],
                end: &[Lanes<T>],
                out: &mut TilePlane<T>,
            ) {
                median_tile::<<T as Vectors>::$Vector>(task, masks, end, out);
            }
        }
    };
}
compiled_for!(avx2, Avx2, "avx2,fma,bmi1,bmi2,popcnt,lzcnt");
compiled_for!(
    avx512,
    Avx512,
    "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt"
);

#[allow(unsafe_code)]
fn forward_level<T: Vectors, const K: usize, const DEGREE: usize>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    open: &[u16; MAX_BLOCKS],
    out: TileImage<'_, T>,
) {
    match level {
        SimdLevel::Baseline => forward_tile::<T::Baseline, K, DEGREE>(task, open, out),
        #[cfg(target_arch = "aarch64")]
        SimdLevel::Neon => forward_tile::<T::Baseline, K, DEGREE>(task, open, out),
        // SAFETY: a level other than the baseline comes from `available`, which has detected its features.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { avx2::forward::<T, K, DEGREE>(task, open, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe { avx512::forward::<T, K, DEGREE>(task, open, out) },
    }
}

#[allow(unsafe_code)]
fn backward_level<T: Vectors, const K: usize, const ABSOLUTE: bool, const DEGREE: usize>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    pixels: &TileCotangents<'_, T>,
    slots: &mut [T],
    size: usize,
) {
    match level {
        SimdLevel::Baseline => backward_tile::<T::Baseline, K, ABSOLUTE, DEGREE>(task, pixels, slots, size),
        #[cfg(target_arch = "aarch64")]
        SimdLevel::Neon => backward_tile::<T::Baseline, K, ABSOLUTE, DEGREE>(task, pixels, slots, size),
        // SAFETY: a level other than the baseline comes from `available`, which has detected its features.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { avx2::backward::<T, K, ABSOLUTE, DEGREE>(task, pixels, slots, size) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe { avx512::backward::<T, K, ABSOLUTE, DEGREE>(task, pixels, slots, size) },
    }
}

/// Composites the next (at most `MAX_CHANNELS`) channels of a tile; unused channels of a kernel are zero. For rough
/// exponentials there are fewer kernels.
pub(crate) fn forward<T: Vectors>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    open: &[u16; MAX_BLOCKS],
    out: TileImage<'_, T>,
) {
    if T::HAS_EXP_DEGREES {
        match task.limits.exp_degree {
            3 => return forward_rough::<T, 3>(level, task, open, out),
            4 => return forward_rough::<T, 4>(level, task, open, out),
            _ => {}
        }
    }
    match task.channels.total - task.first {
        1 => forward_level::<T, 1, FINEST>(level, task, open, out),
        2..=3 => forward_level::<T, 3, FINEST>(level, task, open, out),
        4 => forward_level::<T, 4, FINEST>(level, task, open, out),
        5..=6 => forward_level::<T, 6, FINEST>(level, task, open, out),
        _ => forward_level::<T, MAX_CHANNELS, FINEST>(level, task, open, out),
    }
}

fn forward_rough<T: Vectors, const DEGREE: usize>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    open: &[u16; MAX_BLOCKS],
    out: TileImage<'_, T>,
) {
    match task.channels.total - task.first {
        1..=3 => forward_level::<T, 3, DEGREE>(level, task, open, out),
        _ => forward_level::<T, MAX_CHANNELS, DEGREE>(level, task, open, out),
    }
}

/// The vjp of [`forward`], written to `slots`; `absolute` says whether they have absolutes, for which, too, there are
/// fewer kernels.
pub(crate) fn backward<T: Vectors>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    pixels: &TileCotangents<'_, T>,
    slots: &mut [T],
    size: usize,
    absolute: bool,
) {
    if T::HAS_EXP_DEGREES {
        match task.limits.exp_degree {
            3 => return backward_rough::<T, 3>(level, task, pixels, slots, size, absolute),
            4 => return backward_rough::<T, 4>(level, task, pixels, slots, size, absolute),
            _ => {}
        }
    }
    match (task.channels.total - task.first, absolute) {
        (1..=4, true) => backward_level::<T, 4, true, FINEST>(level, task, pixels, slots, size),
        (_, true) => backward_level::<T, MAX_CHANNELS, true, FINEST>(level, task, pixels, slots, size),
        (1, _) => backward_level::<T, 1, false, FINEST>(level, task, pixels, slots, size),
        (2..=3, _) => backward_level::<T, 3, false, FINEST>(level, task, pixels, slots, size),
        (4, _) => backward_level::<T, 4, false, FINEST>(level, task, pixels, slots, size),
        (5..=6, _) => backward_level::<T, 6, false, FINEST>(level, task, pixels, slots, size),
        _ => backward_level::<T, MAX_CHANNELS, false, FINEST>(level, task, pixels, slots, size),
    }
}

fn backward_rough<T: Vectors, const DEGREE: usize>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    pixels: &TileCotangents<'_, T>,
    slots: &mut [T],
    size: usize,
    absolute: bool,
) {
    match (task.channels.total - task.first, absolute) {
        (_, true) => backward_level::<T, MAX_CHANNELS, true, DEGREE>(level, task, pixels, slots, size),
        (1..=3, _) => backward_level::<T, 3, false, DEGREE>(level, task, pixels, slots, size),
        _ => backward_level::<T, MAX_CHANNELS, false, DEGREE>(level, task, pixels, slots, size),
    }
}

/// The median splat of every pixel of a tile; see [`median_tile`].
#[allow(unsafe_code)]
pub(crate) fn median<T: Vectors>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    masks: &[u16],
    end: &[Lanes<T>],
    out: &mut TilePlane<T>,
) {
    match level {
        SimdLevel::Baseline => median_tile::<T::Baseline>(task, masks, end, out),
        #[cfg(target_arch = "aarch64")]
        SimdLevel::Neon => median_tile::<T::Baseline>(task, masks, end, out),
        // SAFETY: a level other than the baseline comes from `available`, which has detected its features.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { avx2::median::<T>(task, masks, end, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe { avx512::median::<T>(task, masks, end, out) },
    }
}

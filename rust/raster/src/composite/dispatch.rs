//! Picks the kernel for a number of channels and an exponential, and runs it at a CPU feature level.

use crate::composite::kernel::{
    Lanes, MAX_BLOCKS, MAX_CHANNELS, TileCotangents, TileImage, TilePlane, TileTask, backward_tile,
    forward_tile, median_tile,
};
use crate::memory::shared_slice::OwnPieces;
use crate::simd::Vectors;
use crate::simd::level::{Simd, SimdLevel, Work};
use crate::simd::vector::FINEST;

/// Channels that the kernel for the last group may have more than are left: no number has a kernel of its own in
/// [`forward_rough`].
pub(crate) const SPARE_CHANNELS: usize = MAX_CHANNELS - 4;

/// [`forward_tile`] for K channels and a degree of the exponential.
struct Forward<'a, T, const K: usize, const DEGREE: usize> {
    task: &'a TileTask<'a, T>,
    open: &'a [u16; MAX_BLOCKS],
    out: TileImage<'a, T>,
}

impl<T: Vectors, const K: usize, const DEGREE: usize> Work for Forward<'_, T, K, DEGREE> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        forward_tile::<T::In<S>, K, DEGREE>(simd, self.task, self.open, self.out);
    }
}

/// [`backward_tile`] for K channels and a degree of the exponential, with absolutes or without.
struct Backward<'a, T, const K: usize, const ABSOLUTE: bool, const DEGREE: usize> {
    task: &'a TileTask<'a, T>,
    pixels: &'a TileCotangents<'a, T>,
    gradients: OwnPieces<'a, T>,
}

impl<T: Vectors, const K: usize, const ABSOLUTE: bool, const DEGREE: usize> Work
    for Backward<'_, T, K, ABSOLUTE, DEGREE>
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        backward_tile::<T::In<S>, K, ABSOLUTE, DEGREE>(simd, self.task, self.pixels, self.gradients);
    }
}

/// [`median_tile`].
struct Median<'a, T> {
    task: &'a TileTask<'a, T>,
    masks: &'a [u64],
    end: &'a [Lanes<T>],
    out: &'a mut TilePlane<T>,
}

impl<T: Vectors> Work for Median<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        median_tile::<T::In<S>>(simd, self.task, self.masks, self.end, self.out);
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
        1 => level.run(Forward::<_, 1, FINEST> { task, open, out }),
        2..=3 => level.run(Forward::<_, 3, FINEST> { task, open, out }),
        4 => level.run(Forward::<_, 4, FINEST> { task, open, out }),
        5..=6 => level.run(Forward::<_, 6, FINEST> { task, open, out }),
        _ => level.run(Forward::<_, MAX_CHANNELS, FINEST> { task, open, out }),
    }
}

fn forward_rough<T: Vectors, const DEGREE: usize>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    open: &[u16; MAX_BLOCKS],
    out: TileImage<'_, T>,
) {
    match task.channels.total - task.first {
        1..=3 => level.run(Forward::<_, 3, DEGREE> { task, open, out }),
        _ => level.run(Forward::<_, MAX_CHANNELS, DEGREE> { task, open, out }),
    }
}

/// The vjp of [`forward`], written to `gradients`; `absolute` says whether they have absolutes, for which there are fewer
/// kernels as well.
pub(crate) fn backward<T: Vectors>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    pixels: &TileCotangents<'_, T>,
    gradients: OwnPieces<'_, T>,
    absolute: bool,
) {
    if T::HAS_EXP_DEGREES {
        match task.limits.exp_degree {
            3 => return backward_rough::<T, 3>(level, task, pixels, gradients, absolute),
            4 => return backward_rough::<T, 4>(level, task, pixels, gradients, absolute),
            _ => {}
        }
    }
    match (task.channels.total - task.first, absolute) {
        (1..=4, true) => level.run(Backward::<_, 4, true, FINEST> {
            task,
            pixels,
            gradients,
        }),
        (_, true) => level.run(Backward::<_, MAX_CHANNELS, true, FINEST> {
            task,
            pixels,
            gradients,
        }),
        (1, _) => level.run(Backward::<_, 1, false, FINEST> {
            task,
            pixels,
            gradients,
        }),
        (2..=3, _) => level.run(Backward::<_, 3, false, FINEST> {
            task,
            pixels,
            gradients,
        }),
        (4, _) => level.run(Backward::<_, 4, false, FINEST> {
            task,
            pixels,
            gradients,
        }),
        (5..=6, _) => level.run(Backward::<_, 6, false, FINEST> {
            task,
            pixels,
            gradients,
        }),
        _ => level.run(Backward::<_, MAX_CHANNELS, false, FINEST> {
            task,
            pixels,
            gradients,
        }),
    }
}

fn backward_rough<T: Vectors, const DEGREE: usize>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    pixels: &TileCotangents<'_, T>,
    gradients: OwnPieces<'_, T>,
    absolute: bool,
) {
    match (task.channels.total - task.first, absolute) {
        (_, true) => level.run(Backward::<_, MAX_CHANNELS, true, DEGREE> {
            task,
            pixels,
            gradients,
        }),
        (1..=3, _) => level.run(Backward::<_, 3, false, DEGREE> {
            task,
            pixels,
            gradients,
        }),
        _ => level.run(Backward::<_, MAX_CHANNELS, false, DEGREE> {
            task,
            pixels,
            gradients,
        }),
    }
}

/// The median splat of every pixel of a tile; see [`median_tile`].
pub(crate) fn median<T: Vectors>(
    level: SimdLevel,
    task: &TileTask<'_, T>,
    masks: &[u64],
    end: &[Lanes<T>],
    out: &mut TilePlane<T>,
) {
    level.run(Median {
        task,
        masks,
        end,
        out,
    });
}

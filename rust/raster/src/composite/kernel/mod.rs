//! The two inner loops: one tile forward, one tile backward.
//!
//! A tile is cut into blocks of 4×4 pixels, 16 lanes: one AVX-512 vector, two of AVX2, four of SSE2 or NEON. The loops are
//! written once, over the trait [`Vector`], and compiled once per CPU feature level.
//!
//! Forward walks block by block, so that transmittance and colour stay in registers while a block's own list goes by.
//! Backward walks splat by splat, back to front, so that a splat's gradient is reduced once per tile, and recomputes
//! alpha: cheaper than storing it.

mod backward;
mod forward;
mod median;
mod reach;
#[cfg(test)]
mod tests;

pub(crate) use backward::{TileCotangents, backward_tile};
pub(crate) use forward::{TileImage, forward_tile};
pub(crate) use median::median_tile;

use crate::input::channels::Channels;
use crate::input::settings::Limits;
use crate::math::real::Real;
use crate::project::splat::{Splat, log_threshold};
use crate::simd::prefetch;
use crate::simd::vector::Vector;

/// Pixels in a block.
pub(crate) const LANES: usize = 16;
/// Pixels along a side of a block.
pub(crate) const BLOCK: usize = 4;
/// Most pixels along a side of a tile.
pub(crate) const MAX_SIDE: usize = 32;
/// Most blocks in a tile.
pub(crate) const MAX_BLOCKS: usize = 64;
/// Gradient values of an intersection before those of the channels: h, hu, hv, huu, huv, hvv, where h is the gradient of
/// alpha times alpha.
pub(crate) const MOMENTS: usize = 6;
/// Gradient values after those of the channels where they are asked for: Σ |h u|, and Σ |h (w12 u + w22 v)|.
pub(crate) const ABSOLUTES: usize = 2;
/// Most channels composited at once.
pub(crate) const MAX_CHANNELS: usize = 8;
/// Splats whose block masks make a word per block.
const WORD: usize = 64;
/// How many splats ahead of the one being loaded are prefetched.
const AHEAD: usize = 40;

/// One value per pixel of a block, aligned to a cache line: a load that straddles two is slow.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(crate) struct Lanes<T>(pub(crate) [T; LANES]);

impl<T: Real> Default for Lanes<T> {
    fn default() -> Self {
        Self::ZERO
    }
}

impl<T: Real> Lanes<T> {
    pub(crate) const ZERO: Self = Self([T::ZERO; LANES]);
    pub(crate) const ONE: Self = Self([T::ONE; LANES]);

    /// By row of the block.
    #[inline(always)]
    pub(crate) fn rows(&self) -> &[[T; BLOCK]] {
        self.0.as_chunks().0
    }

    /// By row of the block.
    #[inline(always)]
    pub(crate) fn rows_mut(&mut self) -> &mut [[T; BLOCK]] {
        self.0.as_chunks_mut().0
    }

    #[inline(always)]
    fn get<V: Vector<Scalar = T>>(&self, level: V::Level, first: usize) -> V {
        V::load(level, &self.0[first..first + V::LANES])
    }

    #[inline(always)]
    fn set<V: Vector<Scalar = T>>(&mut self, first: usize, values: V) {
        values.store(&mut self.0[first..first + V::LANES]);
    }
}

/// One value per pixel of a tile.
pub(crate) type TilePlane<T> = [Lanes<T>; MAX_BLOCKS];

/// Where coordinates of the kernels have their zero: the middle of the 32×32 pixels around the tile with this first pixel.
/// Small coordinates round least, and an anchor that is the same for tiles of any size gives the same bits for each.
pub(crate) fn anchor<T: Real>((left, top): (usize, usize)) -> [T; 2] {
    [left, top].map(|first| T::of((first - first % MAX_SIDE + MAX_SIDE / 2) as f64))
}

/// One tile's work: everything but the outputs.
#[derive(Clone, Copy)]
pub(crate) struct TileTask<'a, T> {
    /// Top-left pixel.
    pub(crate) origin: (usize, usize),
    /// [`anchor`] of it.
    pub(crate) anchor: [T; 2],
    /// Blocks along a side.
    pub(crate) side: usize,
    /// The tile's list, front to back: see [`crate::lists::tile_lists::TileLists::entries`].
    pub(crate) entries: &'a [[u32; 2]],
    /// By Gaussian.
    pub(crate) splats: &'a [Splat<T>],
    /// Camera z by Gaussian.
    pub(crate) depths: &'a [T],
    pub(crate) channels: Channels<'a, T>,
    /// First of the channels handled now.
    pub(crate) first: usize,
    pub(crate) limits: &'a Limits<T>,
}

impl<T: Real> TileTask<'_, T> {
    /// The first pixel centre of the tile, from its anchor.
    #[inline(always)]
    fn first_centre(&self) -> [T; 2] {
        let first = |first: usize| T::of((first % MAX_SIDE) as f64 + 0.5 - (MAX_SIDE / 2) as f64);
        [first(self.origin.0), first(self.origin.1)]
    }

    /// Prefetches the splat of a place in the list. Neighbours in the list are no neighbours in memory.
    #[inline(always)]
    fn prefetch(&self, index: usize) {
        if let Some(&[gaussian, _]) = self.entries.get(index) {
            prefetch(self.splats, gaussian as usize);
        }
    }

    /// Centre of a splat from the tile's anchor.
    #[inline(always)]
    fn centre(&self, splat: &Splat<T>) -> [T; 2] {
        [splat.x - self.anchor[0], splat.y - self.anchor[1]]
    }

    /// log₂ of the least alpha of a pair that counts; infinite if alpha is limited to less than the threshold.
    #[inline(always)]
    fn log_threshold(&self) -> T {
        if self.limits.max_alpha >= self.limits.alpha_threshold {
            log_threshold(self.limits)
        } else {
            T::of(f64::INFINITY)
        }
    }
}

/// A splat as a tile sees it: (u, v) = (w11 x + w12 y + u0, w22 y + v0) at (x, y) from the tile's anchor, and the
/// values of K channels. One cache line in f32.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
struct Entry<T, const K: usize> {
    w11: T,
    w12: T,
    u0: T,
    w22: T,
    v0: T,
    log_opacity: T,
    /// Place in the list as a number that compares as the place does.
    place: T,
    values: [T; K],
}

impl<T: Real, const K: usize> Entry<T, K> {
    const ZERO: Self = Self {
        w11: T::ZERO,
        w12: T::ZERO,
        u0: T::ZERO,
        w22: T::ZERO,
        v0: T::ZERO,
        log_opacity: T::ZERO,
        place: T::ZERO,
        values: [T::ZERO; K],
    };

    #[inline(always)]
    fn load(task: &TileTask<'_, T>, index: usize) -> Self {
        let gaussian = task.entries[index][0] as usize;
        let splat = &task.splats[gaussian];
        let [x, y] = task.centre(splat);
        let mut values = [T::ZERO; K];
        if task.first == 0 {
            values.copy_from_slice(&splat.values[..K]);
        } else {
            let c = &task.channels;
            for (channel, value) in (task.first..c.total).zip(&mut values) {
                *value = if channel < c.colored {
                    c.colors[gaussian * c.stride + channel]
                } else {
                    task.depths[gaussian]
                };
            }
        }
        let w12 = splat.w12();
        Self {
            w11: splat.w11,
            w12,
            u0: -(splat.w11 * x + w12 * y),
            w22: splat.w22,
            v0: -(splat.w22 * y),
            log_opacity: splat.log_opacity,
            place: T::ordinal(index as u32),
            values,
        }
    }

    #[inline(always)]
    fn whitened<V: Vector<Scalar = T>>(&self, x: V, y: V) -> (V, V) {
        let all = |value| V::splat(x.level(), value);
        let u = all(self.w12).times_plus(y, all(self.u0));
        (
            all(self.w11).times_plus(x, u),
            all(self.w22).times_plus(y, all(self.v0)),
        )
    }

    /// log₂ of alpha before it is limited: opacity · 2^−(u² + v²).
    #[inline(always)]
    fn log_alpha<V: Vector<Scalar = T>>(&self, u: V, v: V) -> V {
        let v2 = v.times_minus(v, V::splat(v.level(), self.log_opacity));
        u.minus_times_minus(u, v2)
    }
}

/// Pixel centres of every block from the tile's anchor.
struct PixelCentres<T> {
    /// Of the first block.
    x: Lanes<T>,
    y: Lanes<T>,
    /// How far each block is from the first.
    shifts: [[T; 2]; MAX_BLOCKS],
}

impl<T: Real> PixelCentres<T> {
    #[inline(always)]
    fn new(task: &TileTask<'_, T>) -> Self {
        let ([x, y], side) = (task.first_centre(), task.side);
        let mut shifts = [[T::ZERO; 2]; MAX_BLOCKS];
        for (row, shifts) in shifts[..side * side].chunks_exact_mut(side).enumerate() {
            for (column, shift) in shifts.iter_mut().enumerate() {
                *shift = [column, row].map(|at| T::of((at * BLOCK) as f64));
            }
        }
        Self {
            x: Lanes(std::array::from_fn(|i| x + T::of((i % BLOCK) as f64))),
            y: Lanes(std::array::from_fn(|i| y + T::of((i / BLOCK) as f64))),
            shifts,
        }
    }

    /// Those of a block, from a lane on. Exact: they are small multiples of one half.
    #[inline(always)]
    fn of<V: Vector<Scalar = T>>(&self, level: V::Level, block: usize, lane: usize) -> (V, V) {
        let [x, y] = self.shifts[block & (MAX_BLOCKS - 1)];
        (
            self.x.get::<V>(level, lane).plus(V::splat(level, x)),
            self.y.get::<V>(level, lane).plus(V::splat(level, y)),
        )
    }
}

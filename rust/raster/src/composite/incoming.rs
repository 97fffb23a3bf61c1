//! The gradients that come into a tile: read into planes for the kernels, and summed into that of the background.

use crate::composite::forward::{Canvas, LEAST_ALPHA};
use crate::composite::kernel::{BLOCK, LANES, Lanes, MAX_BLOCKS, MAX_CHANNELS, MAX_SIDE, TilePlane};
use crate::composite::scene::Scene;
use crate::math::real::Real;
use crate::memory::pool::{Buffers, Pooled, bytes_of};
use crate::simd::level::{Simd, Work};

/// Gradients of an image.
#[derive(Clone, Copy)]
pub(crate) struct Cotangents<'a, T> {
    /// As the image: rows, columns, channels.
    pub(crate) colors: &'a [T],
    pub(crate) alphas: &'a [T],
}

/// Lane by lane, then over the lanes.
#[inline(always)]
fn dot<T: Real>(a: &[Lanes<T>], b: &[Lanes<T>]) -> T {
    let mut sums = [T::ZERO; LANES];
    for (a, b) in a.iter().zip(b) {
        for i in 0..LANES {
            sums[i] += a.0[i] * b.0[i];
        }
    }
    sums.into_iter().sum()
}

/// Sums the incoming gradients of a tile that nothing reaches: those of the background.
pub(crate) struct SumIncoming<'a, T> {
    pub(crate) scene: &'a Scene<'a, T>,
    pub(crate) tile: usize,
    pub(crate) v: Cotangents<'a, T>,
    pub(crate) sums: &'a mut [T],
}

impl<T: Real> Work for SumIncoming<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        match (self.sums.len(), self.scene.pixel_mask) {
            (1, None) => self.sum::<1>(),
            (3, None) => self.sum::<3>(),
            (4, None) => self.sum::<4>(),
            (total, mask) => {
                let Self { scene, tile, v, sums } = self;
                scene.for_block_rows(tile, |_, _, pixel, count| {
                    for pixel in (pixel..pixel + count).filter(|&pixel| mask.is_none_or(|mask| mask[pixel])) {
                        for (sum, &v) in sums.iter_mut().zip(&v.colors[pixel * total..]) {
                            *sum += v;
                        }
                    }
                });
            }
        }
    }
}

impl<T: Real> SumIncoming<'_, T> {
    /// Of K channels and all pixels: by column of the tile, then over the columns.
    #[inline(always)]
    fn sum<const K: usize>(self) {
        let (grid, colors) = (&self.scene.grid, self.v.colors.as_chunks::<K>().0);
        let (left, top) = grid.origin(self.tile);
        let columns = grid.tile_size.min(grid.width - left);
        let mut sums = [[T::ZERO; K]; MAX_SIDE];
        for y in top..(top + grid.tile_size).min(grid.height) {
            let row = &colors[y * grid.width + left..][..columns];
            if let Some(row) = row.first_chunk::<MAX_SIDE>() {
                for x in 0..MAX_SIDE {
                    for k in 0..K {
                        sums[x][k] += row[x][k];
                    }
                }
            } else {
                for (sum, values) in sums.iter_mut().zip(row) {
                    for k in 0..K {
                        sum[k] += values[k];
                    }
                }
            }
        }
        for sum in sums {
            for k in 0..K {
                self.sums[k] += sum[k];
            }
        }
    }
}

/// [`Incoming::load`], and the part of the background's gradient where there is one.
pub(crate) struct Load<'a, T> {
    pub(crate) incoming: &'a mut Incoming<T>,
    pub(crate) scene: &'a Scene<'a, T>,
    pub(crate) canvas: &'a Canvas<T>,
    pub(crate) tile: usize,
    pub(crate) first: usize,
    pub(crate) v: Cotangents<'a, T>,
    /// Of all channels.
    pub(crate) v_background: &'a mut [T],
}

impl<T: Real> Work for Load<'_, T> {
    type Output = bool;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> bool {
        let (scene, first) = (self.scene, self.first);
        let any = self.incoming.load(scene, self.canvas, self.tile, first, self.v);
        if scene.background.is_some() {
            let transmittance = &self.canvas.transmittance[self.tile * scene.blocks()..][..scene.blocks()];
            for (sum, v) in self.v_background[first..].iter_mut().zip(&self.incoming.v_values) {
                *sum = dot(transmittance, v);
            }
        }
        any
    }
}

/// The incoming gradients of one tile, for one group of channels.
pub(crate) struct Incoming<T> {
    /// One plane per channel. A kernel may have more channels than are left, and finds zeros there.
    pub(crate) v_values: Vec<TilePlane<T>>,
    /// Planes beyond so many are zero.
    used: usize,
    pub(crate) v_transmittance: TilePlane<T>,
}

impl<T: Real> Default for Incoming<T> {
    fn default() -> Self {
        Self {
            v_values: Vec::new(),
            used: 0,
            v_transmittance: [Lanes::ZERO; MAX_BLOCKS],
        }
    }
}

impl<T: Real> Buffers for Incoming<T> {
    fn bytes(&self) -> usize {
        size_of::<Self>() + bytes_of(&self.v_values)
    }
}

impl<T: Real> Incoming<T> {
    pub(crate) fn pooled() -> Pooled<Self> {
        let mut incoming = Pooled::<Self>::take();
        incoming.v_values.resize(MAX_CHANNELS, [Lanes::ZERO; MAX_BLOCKS]);
        incoming
    }

    /// Zeroes the planes from `first` on that hold anything; `used` of all are about to be written.
    #[inline(always)]
    fn clear(&mut self, first: usize, used: usize) {
        if first < self.used {
            self.v_values[first..self.used].fill([Lanes::ZERO; MAX_BLOCKS]);
        }
        self.used = used;
    }

    /// Reads the channels from `first` on; whether any gradient is not zero.
    #[inline(always)]
    fn load(
        &mut self,
        scene: &Scene<'_, T>,
        canvas: &Canvas<T>,
        tile: usize,
        first: usize,
        v: Cotangents<'_, T>,
    ) -> bool {
        let total = scene.channels.total;
        let whole = scene.pixel_mask.is_none()
            && scene.grid.origin(tile).0 + scene.grid.tile_size <= scene.grid.width
            && scene.grid.origin(tile).1 + scene.grid.tile_size <= scene.grid.height;
        let background: [T; MAX_CHANNELS] = std::array::from_fn(|k| scene.background(first + k));
        if whole && !scene.expected_depth && first == 0 {
            match (total, scene.background.is_some()) {
                (1, false) => return self.load_whole::<1, false>(scene, tile, v, &background),
                (3, false) => return self.load_whole::<3, false>(scene, tile, v, &background),
                (4, false) => return self.load_whole::<4, false>(scene, tile, v, &background),
                (1, true) => return self.load_whole::<1, true>(scene, tile, v, &background),
                (3, true) => return self.load_whole::<3, true>(scene, tile, v, &background),
                (4, true) => return self.load_whole::<4, true>(scene, tile, v, &background),
                (5, false) => return self.load_whole::<5, false>(scene, tile, v, &background),
                (6, false) => return self.load_whole::<6, false>(scene, tile, v, &background),
                _ => {}
            }
        }
        let used = (total - first).min(MAX_CHANNELS);
        self.clear(0, used);
        self.v_transmittance[..scene.blocks()].fill(Lanes::ZERO);
        let mut any = false;
        let least = T::of(LEAST_ALPHA);
        scene.for_block_rows(tile, |block, lane, pixel, count| {
            for i in 0..count {
                let (pixel, lane) = (pixel + i, lane + i);
                if !scene.pixel_mask.is_none_or(|mask| mask[pixel]) {
                    continue;
                }
                // Alpha is 1 − transmittance; it belongs to the first group of channels.
                let mut v_alpha = if first == 0 { v.alphas[pixel] } else { T::ZERO };
                let mut v_transmittance = T::ZERO;
                let incoming = &v.colors[pixel * total + first..][..used];
                for k in 0..used {
                    let mut value = incoming[k];
                    if scene.expected_depth && first + k == total - 1 {
                        let place = tile * scene.blocks() + block;
                        let alpha = T::ONE - canvas.transmittance[place].0[lane];
                        value = value / alpha.greater(least);
                        if alpha > least {
                            v_alpha += -(value * (canvas.depths[place].0[lane] / alpha));
                        }
                    }
                    self.v_values[k][block].0[lane] = value;
                    v_transmittance += value * background[k];
                    any |= value != T::ZERO;
                }
                any |= v_alpha != T::ZERO;
                self.v_transmittance[block].0[lane] = v_transmittance + -v_alpha;
            }
        });
        any
    }

    /// A tile within the image, all of whose K channels are colours or plain depth.
    #[inline(always)]
    fn load_whole<const K: usize, const BACKGROUND: bool>(
        &mut self,
        scene: &Scene<'_, T>,
        tile: usize,
        v: Cotangents<'_, T>,
        background: &[T; MAX_CHANNELS],
    ) -> bool {
        self.clear(K, K);
        // Of absolute values: as long as all are zero, so is it. Comparisons would be made one by one.
        let mut sums = [T::ZERO; BLOCK];
        let colors = v.colors.as_chunks::<K>().0;
        let ((left, top), size) = (scene.grid.origin(tile), scene.grid.tile_size);
        // A loop and no closure: one that is not inlined would be compiled for the baseline.
        for y in 0..size {
            let start = (top + y) * scene.grid.width + left;
            let (colors, alphas) = (&colors[start..start + size], &v.alphas[start..start + size]);
            let (colors, alphas) = (colors.as_chunks::<BLOCK>().0, alphas.as_chunks::<BLOCK>().0);
            let (first, row) = (y / BLOCK * (size / BLOCK), y % BLOCK);
            for (block, (colors, alphas)) in (first..MAX_BLOCKS).zip(colors.iter().zip(alphas)) {
                let mut v_transmittance = [T::ZERO; BLOCK];
                for k in 0..K {
                    let values: [T; BLOCK] = [colors[0][k], colors[1][k], colors[2][k], colors[3][k]];
                    self.v_values[k][block].rows_mut()[row] = values;
                    for i in 0..BLOCK {
                        sums[i] += values[i].abs();
                        if BACKGROUND {
                            v_transmittance[i] += values[i] * background[k];
                        }
                    }
                }
                for i in 0..BLOCK {
                    sums[i] += alphas[i].abs();
                    v_transmittance[i] += -alphas[i];
                }
                self.v_transmittance[block].rows_mut()[row] = v_transmittance;
            }
        }
        sums != [T::ZERO; BLOCK]
    }
}

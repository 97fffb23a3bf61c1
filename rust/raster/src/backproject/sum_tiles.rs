//! From the slots of (Gaussian, tile) pairs to the gradients of splats: sums in the order of the tiles.

use crate::composite::kernel::{ABSOLUTES, Channels, LANES, MOMENTS};
use crate::composite::slots::slot_size;
use crate::math::real::Real;
use crate::project::packet::{ChunkGradients, is_sound};
use crate::project::splat::Splat;
use crate::project::tiles::Cover;
use crate::simd::prefetch;

/// Slots that are asked for ahead of the one being summed.
const AHEAD: usize = 16;

/// The slots of a chunk of Gaussians.
pub(crate) struct ChunkSlots<'a, T> {
    /// Of all chunks.
    pub(crate) values: &'a [T],
    pub(crate) channels: Channels<'a, T>,
    pub(crate) absolute: bool,
    /// Of all chunks: see [`crate::lists::tile_lists::TileLists::positions`].
    pub(crate) positions: &'a [u32],
    pub(crate) cover: &'a Cover,
    pub(crate) splats: &'a [Splat<T>],
}

/// Gradients of a chunk that no camera has a part in; an empty slice is one that nobody asked for.
pub(crate) struct ScreenGradients<'a, T> {
    pub(crate) colors: &'a mut [T],
    pub(crate) means2d: &'a mut [[T; 2]],
    pub(crate) absgrad: &'a mut [[T; 2]],
    /// Leave what passes through `means2d` out of the moments.
    pub(crate) detach_means2d: bool,
}

/// The sums of one Gaussian's slots.
struct Sums<T> {
    moments: [T; MOMENTS],
    /// Gradient of depth as a channel.
    depth: T,
    absolutes: [T; ABSOLUTES],
}

impl<T: Real> ChunkSlots<'_, T> {
    /// Sums values `first..first + LANES` of the slots at these positions; more than a slot has mean nothing.
    #[inline(always)]
    fn vector(&self, positions: &[u32], size: usize, first: usize) -> [T; LANES] {
        let mut sum = [T::ZERO; LANES];
        for &position in positions {
            let values = &self.values[position as usize * size + first..][..LANES];
            for k in 0..LANES {
                sum[k] += values[k];
            }
        }
        sum
    }

    /// Sums the slots of one Gaussian; writes the gradients of its colours to `colors` (none if empty).
    #[inline(always)]
    fn sums(&self, positions: &[u32], size: usize, colors: &mut [T]) -> Sums<T> {
        let Channels { total, colored, .. } = self.channels;
        let values = self.vector(positions, size, 0);
        let mut sums = Sums {
            moments: std::array::from_fn(|k| values[k]),
            depth: T::ZERO,
            absolutes: [T::ZERO; ABSOLUTES],
        };
        if colored == 3 && size == MOMENTS + 3 {
            // The usual case.
            if let Some(colors) = colors.first_chunk_mut::<3>() {
                *colors = std::array::from_fn(|k| values[MOMENTS + k]);
            }
            return sums;
        }
        for first in (0..size).step_by(LANES) {
            let values = self.vector(positions, size, first);
            for (place, &value) in (first..size).zip(&values) {
                let Some(channel) = place.checked_sub(MOMENTS) else {
                    continue;
                };
                if channel < colored {
                    if let Some(color) = colors.get_mut(channel) {
                        *color = value;
                    }
                } else if channel < total {
                    sums.depth = value;
                } else {
                    sums.absolutes[channel - total] = value;
                }
            }
        }
        sums
    }
}

/// A gradient, or none if it is beyond the scalar's range, as in [`crate::project::packet::vjp_chunk`]; `from` is what it was made of.
#[inline(always)]
fn kept<T: Real>(gradient: [T; 2], from: [T; 2]) -> [T; 2] {
    if !is_sound(gradient) & is_sound(from) {
        [T::ZERO; 2]
    } else {
        gradient
    }
}

/// Sums the slots of each Gaussian of a chunk, and packs the moments for [`crate::project::packet::vjp_chunk`].
#[inline(always)]
pub(crate) fn gather_chunk<T: Real>(
    from: &ChunkSlots<'_, T>,
    out: ScreenGradients<'_, T>,
    v: &mut ChunkGradients<T>,
) {
    let size = slot_size(from.channels.total, from.absolute);
    let Channels { stride, colored, .. } = from.channels;
    // alpha = opacity · 2^e, e = −(u² + v²).
    let gain = T::of(2.0 * std::f64::consts::LN_2);
    for local in 0..from.cover.len() {
        let own = from.cover.pairs_of(local);
        if own.is_empty() {
            continue;
        }
        // Slots lie tile by tile: one Gaussian's, and the next one's, are far apart.
        let ahead = (own.start + AHEAD).min(from.positions.len());
        for &position in &from.positions[ahead..(ahead + own.len()).min(from.positions.len())] {
            prefetch(from.values, position as usize * size);
            prefetch(from.values, position as usize * size + size - 1);
        }
        let colors = if out.colors.is_empty() {
            &mut []
        } else {
            &mut out.colors[local * stride..][..colored]
        };
        let sums = from.sums(&from.positions[own], size, colors);
        let (splat, [h, mut hu, mut hv, huu, huv, hvv]) = (&from.splats[local], sums.moments);
        if let Some(v) = out.absgrad.get_mut(local) {
            let [x, y] = sums.absolutes;
            *v = kept([gain * splat.w11 * x, gain * y], [x, y]);
        }
        if let Some(v) = out.means2d.get_mut(local) {
            *v = kept(
                [gain * splat.w11 * hu, gain * (splat.w12 * hu + splat.w22 * hv)],
                [hu, hv],
            );
            if out.detach_means2d {
                (hu, hv) = (T::ZERO, T::ZERO);
            }
        }
        v.push(local, [h, hu, hv, huu, huv, hvv, sums.depth]);
    }
}

//! One tile, back to front, gradients.

use super::{ABSOLUTES, Entry, LANES, Lanes, MAX_BLOCKS, MOMENTS, PixelCentres, TilePlane, TileTask, WORD};
use crate::math::real::Real;
use crate::memory::shared_slice::OwnPieces;
use crate::simd::prefetch;
use crate::simd::vector::{MAX_SUMS, Vector};

/// What backward needs of a tile's pixels, in block order.
pub(crate) struct TileCotangents<'a, T> {
    pub(crate) transmittance: &'a [Lanes<T>],
    pub(crate) end: &'a [Lanes<T>],
    pub(crate) masks: &'a [u64],
    /// Gradients of the channels handled now.
    pub(crate) v_values: &'a [TilePlane<T>],
    /// Gradient of the final transmittance, from alpha and background.
    pub(crate) v_transmittance: &'a TilePlane<T>,
}

/// A block of pixels while splats are differentiated back to front.
#[derive(Clone, Copy)]
struct Block<T, const K: usize> {
    /// Transmittance behind the splat at hand.
    transmittance: Lanes<T>,
    /// What lies behind, per unit of transmittance: Σ weight · value · v, and the background's part.
    behind: Lanes<T>,
    end: Lanes<T>,
    v_values: [Lanes<T>; K],
}

/// A splat's gradients, not yet summed over lanes.
struct Sums<V, const K: usize> {
    moments: [V; MOMENTS],
    v_values: [V; K],
    absolutes: [V; ABSOLUTES],
}

#[inline(always)]
fn absolute<V: Vector>(x: V) -> V {
    x.max(V::splat(x.level(), V::Scalar::ZERO).minus(x))
}

/// The rules of a render in vectors.
struct Rules<V> {
    log_threshold: V,
    max_alpha: V,
    one: V,
}

impl<V: Vector, const K: usize> Sums<V, K> {
    #[inline(always)]
    fn add<const ABSOLUTE: bool, const DEGREE: usize>(
        &mut self,
        entry: &Entry<V::Scalar, K>,
        (x, y): (V, V),
        block: &mut Block<V::Scalar, K>,
        lane: usize,
        rules: &Rules<V>,
    ) {
        let level = rules.one.level();
        let (u, v) = entry.whitened(x, y);
        let log_alpha = entry.log_alpha(u, v);
        let raw = log_alpha.exp2::<DEGREE>();
        let lit = block
            .end
            .get::<V>(level, lane)
            .at_least(V::splat(level, entry.place));
        // Of the logarithm, which is there before alpha is.
        let hit = log_alpha.at_least_where(rules.log_threshold, lit);
        let alpha = raw.min(rules.max_alpha).keep(hit);
        let before = block
            .transmittance
            .get::<V>(level, lane)
            .over(rules.one.minus(alpha));
        let weight = alpha.times(before);
        // The splat's colour less what it hides, both weighted by the incoming gradient.
        let behind = block.behind.get::<V>(level, lane);
        let mut change =
            V::splat(level, entry.values[0]).times_minus(block.v_values[0].get(level, lane), behind);
        for k in 1..K {
            change = V::splat(level, entry.values[k]).times_plus(block.v_values[k].get(level, lane), change);
        }
        // Where alpha is not limited it is raw.
        let h = weight
            .times(change)
            .keep(rules.max_alpha.at_least_where(raw, hit));
        block.transmittance.set(lane, before);
        block.behind.set(lane, alpha.times_plus(change, behind));
        let (hu, hv) = (h.times(u), h.times(v));
        let [m, mu, mv, muu, muv, mvv] = self.moments;
        self.moments = [
            m.plus(h),
            mu.plus(hu),
            mv.plus(hv),
            hu.times_plus(u, muu),
            hu.times_plus(v, muv),
            hv.times_plus(v, mvv),
        ];
        for k in 0..K {
            self.v_values[k] = weight.times_plus(block.v_values[k].get(level, lane), self.v_values[k]);
        }
        if ABSOLUTE {
            let along_y = V::splat(level, entry.w12).times_plus(hu, V::splat(level, entry.w22).times(hv));
            let [x, y] = self.absolutes;
            self.absolutes = [x.plus(absolute(hu)), y.plus(absolute(along_y))];
        }
    }

    /// The moments, then the gradients of the K channels, then the absolutes.
    #[inline(always)]
    fn reduced<const ABSOLUTE: bool>(&self) -> [V::Scalar; MAX_SUMS] {
        let mut all = [V::splat(self.moments[0].level(), V::Scalar::ZERO); MAX_SUMS];
        all[..MOMENTS].copy_from_slice(&self.moments);
        all[MOMENTS..MOMENTS + K].copy_from_slice(&self.v_values);
        if ABSOLUTE {
            all[MOMENTS + K..][..ABSOLUTES].copy_from_slice(&self.absolutes);
        }
        V::sums(&all)
    }
}

/// Writes what [`Sums::reduced`] yields. Groups of channels after the first add to the moments and the absolutes.
#[inline(always)]
fn write<T: Real, const K: usize, const ABSOLUTE: bool>(
    task: &TileTask<'_, T>,
    gradient: &mut [T],
    sums: &[T; MAX_SUMS],
) {
    let total = task.channels.total;
    if !ABSOLUTE && total == K && task.first == 0 {
        // As the general case, with a length that the compiler knows: no calls to copy a few bytes.
        gradient[..MOMENTS + K].copy_from_slice(&sums[..MOMENTS + K]);
        return;
    }
    let used = (total - task.first).min(K);
    let mut put = |place: usize, value: T, anew: bool| {
        gradient[place] = if anew { value } else { gradient[place] + value };
    };
    for k in 0..MOMENTS {
        put(k, sums[k], task.first == 0);
    }
    for k in 0..used {
        put(MOMENTS + task.first + k, sums[MOMENTS + k], true);
    }
    if ABSOLUTE {
        for k in 0..ABSOLUTES {
            put(MOMENTS + total + k, sums[MOMENTS + K + k], task.first == 0);
        }
    }
}

/// Writes, for every splat of the tile, to the piece with its intersection's number: its moments, the gradients of its channels, and the absolutes if ABSOLUTE.
#[inline(always)]
pub(crate) fn backward_tile<V: Vector, const K: usize, const ABSOLUTE: bool, const DEGREE: usize>(
    level: V::Level,
    task: &TileTask<'_, V::Scalar>,
    pixels: &TileCotangents<'_, V::Scalar>,
    mut gradients: OwnPieces<'_, V::Scalar>,
) {
    let (zero, size) = (V::Scalar::ZERO, gradients.size());
    let blocks = task.side * task.side;
    let centres = PixelCentres::new(task);
    let mut state = [Block {
        transmittance: Lanes::ONE,
        behind: Lanes::ZERO,
        end: Lanes::ZERO,
        v_values: [Lanes::ZERO; K],
    }; MAX_BLOCKS];
    // Blocks with an incoming gradient, and the last splat that each uses. The walk goes back to front, so a block is
    // skipped until the walk reaches that splat.
    let mut waiting = 0u64;
    let mut ends = [0usize; MAX_BLOCKS];
    for (b, block) in state[..blocks].iter_mut().enumerate() {
        block.transmittance = pixels.transmittance[b];
        block.behind = pixels.v_transmittance[b];
        block.end = pixels.end[b];
        let mut any = false;
        for i in 0..LANES {
            any |= block.behind.0[i] != zero;
        }
        for k in 0..K {
            block.v_values[k] = pixels.v_values[k][b];
            for i in 0..LANES {
                any |= block.v_values[k].0[i] != zero;
            }
        }
        let end = block.end.0.iter().fold(zero, |end, &lane| end.greater(lane));
        ends[b] = if any { end.past_ordinal() as usize } else { 0 };
        waiting |= u64::from(ends[b] > 0) << b;
    }
    let mut active = 0u64;
    let rules = Rules {
        log_threshold: V::splat(level, task.log_threshold()),
        max_alpha: V::splat(level, task.limits.max_alpha),
        one: V::splat(level, V::Scalar::ONE),
    };

    let mut entries = [Entry::<V::Scalar, K>::ZERO; WORD];
    for batch in (0..task.entries.len()).step_by(WORD).rev() {
        let masks = &pixels.masks[batch..task.entries.len().min(batch + WORD)];
        // The blocks whose last splat is at each place of the batch.
        let mut starting = [0u64; WORD];
        let mut rest = waiting;
        while rest != 0 {
            let b = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            if ends[b] > batch {
                starting[(ends[b] - 1 - batch) & (WORD - 1)] |= 1 << b;
                waiting &= !(1 << b);
            }
        }
        let all = starting.iter().fold(active, |all, blocks| all | blocks);
        for (i, mask) in masks.iter().enumerate() {
            // The next batch, while this one is worked on.
            task.prefetch((batch + i).wrapping_sub(WORD));
            prefetch(gradients.at(task.entries[batch + i][1]), size - 1);
            if mask & all != 0 {
                entries[i] = Entry::load(task, batch + i);
            }
        }
        for (i, mask) in masks.iter().enumerate().rev() {
            active |= starting[i];
            let mut rest = mask & active;
            let gradient = gradients.at(task.entries[batch + i][1]);
            if rest == 0 {
                write::<V::Scalar, K, ABSOLUTE>(task, gradient, &[zero; MAX_SUMS]);
                continue;
            }
            let entry = &entries[i];
            let mut sums = Sums::<V, K> {
                moments: [V::splat(level, zero); MOMENTS],
                v_values: [V::splat(level, zero); K],
                absolutes: [V::splat(level, zero); ABSOLUTES],
            };
            while rest != 0 {
                let b = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                let block = &mut state[b & (MAX_BLOCKS - 1)];
                for lane in (0..LANES).step_by(V::LANES) {
                    let centres = centres.of(level, b, lane);
                    sums.add::<ABSOLUTE, DEGREE>(entry, centres, block, lane, &rules);
                }
            }
            write::<V::Scalar, K, ABSOLUTE>(task, gradient, &sums.reduced::<ABSOLUTE>());
        }
    }
}

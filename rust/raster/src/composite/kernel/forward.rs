//! One tile, front to back.

use super::reach::Outlines;
use super::{AHEAD, Entry, LANES, Lanes, MAX_BLOCKS, PixelCentres, TileTask, WORD};
use crate::math::real::Real;
use crate::simd::transpose_bits;
use crate::simd::vector::Vector;

/// Splats loaded and composited at once: few enough to stay in the first-level cache, and a tile whose pixels have all
/// stopped loads no more.
const BATCH: usize = 2 * WORD;

/// Splats of the next batch that are prefetched with every block.
const AT_ONCE: usize = 4;

/// Where forward writes a tile; pixels in block order. Earlier contents do not matter.
pub(crate) struct TileImage<'a, T> {
    /// For each of the kernel's channels, which may be more than are handled now, a plane of blocks.
    pub(crate) colors: &'a mut [Lanes<T>],
    /// Transmittance behind everything.
    pub(crate) transmittance: &'a mut [Lanes<T>],
    /// [`Real::ordinal`] of the place in the list at which a pixel stopped, or of the end of the list.
    pub(crate) end: &'a mut [Lanes<T>],
    /// Blocks that each listed splat reaches, without blocks that have stopped.
    pub(crate) masks: &'a mut [u64],
    /// How many pixels stopped before the end of the list.
    pub(crate) saturated: &'a mut usize,
}

/// Some pixels of a block while splats are composited front to back.
#[derive(Clone, Copy)]
struct Light<V, const K: usize> {
    /// Transmittance as if no pixel ever stopped. It only falls, so a stopped pixel stays below the limit without being
    /// marked, and the chain from splat to splat is a single multiply-add. 0 for a pixel that is not rendered.
    unstopped: V,
    /// Transmittance when the pixel stopped.
    transmittance: V,
    end: V,
    sums: [V; K],
}

/// The rules of a render in vectors.
struct Rules<V> {
    log_threshold: V,
    max_alpha: V,
    stop: V,
}

impl<V: Vector, const K: usize> Light<V, K> {
    #[inline(always)]
    fn pass<const DEGREE: usize>(&mut self, entry: &Entry<V::Scalar, K>, x: V, y: V, rules: &Rules<V>) {
        let level = x.level();
        let (u, v) = entry.whitened(x, y);
        let log_alpha = entry.log_alpha(u, v);
        // Of the logarithm, which is there before alpha is.
        let hit = log_alpha.at_least(rules.log_threshold);
        let alpha = log_alpha.exp2::<DEGREE>().min(rules.max_alpha).keep(hit);
        let next = alpha.times_from(self.unstopped, self.unstopped);
        let on = next.above(rules.stop);
        let weight = alpha.times(self.unstopped).keep(on);
        self.unstopped = next;
        self.transmittance = next.select(on, self.transmittance);
        self.end = V::splat(level, entry.place).select(on, self.end);
        for k in 0..K {
            self.sums[k] = weight.times_plus(V::splat(level, entry.values[k]), self.sums[k]);
        }
    }
}

/// A block of pixels while splats are composited front to back; see [`Light`].
#[derive(Clone, Copy)]
struct Block<T, const K: usize> {
    unstopped: Lanes<T>,
    transmittance: Lanes<T>,
    end: Lanes<T>,
    sums: [Lanes<T>; K],
}

impl<T: Real, const K: usize> Block<T, K> {
    #[inline(always)]
    fn get<V: Vector<Scalar = T>>(&self, level: V::Level, lane: usize) -> Light<V, K> {
        Light {
            unstopped: self.unstopped.get(level, lane),
            transmittance: self.transmittance.get(level, lane),
            end: self.end.get(level, lane),
            sums: std::array::from_fn(|k| self.sums[k].get(level, lane)),
        }
    }

    #[inline(always)]
    fn set<V: Vector<Scalar = T>>(&mut self, lane: usize, light: &Light<V, K>) {
        self.unstopped.set(lane, light.unstopped);
        self.transmittance.set(lane, light.transmittance);
        self.end.set(lane, light.end);
        for k in 0..K {
            self.sums[k].set(lane, light.sums[k]);
        }
    }
}

/// Composites one tile. `open` says which pixels of each block are to be rendered.
#[inline(always)]
pub(crate) fn forward_tile<V: Vector, const K: usize, const DEGREE: usize>(
    level: V::Level,
    task: &TileTask<'_, V::Scalar>,
    open: &[u16; MAX_BLOCKS],
    out: TileImage<'_, V::Scalar>,
) {
    let blocks = task.side * task.side;
    let mut outlines = Outlines::new(task);
    let centres = PixelCentres::new(task);
    let rules = Rules {
        log_threshold: V::splat(level, task.log_threshold()),
        max_alpha: V::splat(level, task.limits.max_alpha),
        stop: V::splat(level, task.limits.min_transmittance),
    };
    let mut state = [Block::<V::Scalar, K> {
        unstopped: Lanes::ONE,
        transmittance: Lanes::ONE,
        end: Lanes::ZERO,
        sums: [Lanes::ZERO; K],
    }; MAX_BLOCKS];
    let mut taking: u64 = 0;
    for (b, (block, &bits)) in state.iter_mut().zip(open).take(blocks).enumerate() {
        if bits != 0xFFFF {
            block.unstopped = Lanes(std::array::from_fn(|i| V::Scalar::of(f64::from(bits >> i & 1))));
        }
        taking |= u64::from(bits != 0) << b;
    }

    let mut entries = [Entry::<V::Scalar, K>::ZERO; BATCH];
    let mut batch = 0;
    while batch < task.entries.len() && taking != 0 {
        let size = BATCH.min(task.entries.len() - batch);
        let (mut words, mut any) = ([[0u64; WORD]; BATCH / WORD], 0);
        for (w, word) in words.iter_mut().enumerate() {
            let places = w * WORD..size.min((w + 1) * WORD);
            if places.is_empty() {
                break;
            }
            for i in places.clone() {
                task.prefetch(batch + i + AHEAD);
                let splat = &task.splats[task.entries[batch + i][0] as usize];
                outlines.set(i, splat, task.centre(splat));
                entries[i] = Entry::load(task, batch + i);
            }
            let masks = outlines.blocks();
            for ((word, mask), kept) in word.iter_mut().zip(masks).zip(&mut out.masks[batch..][places]) {
                *word = mask & taking;
                *kept = *word;
                any |= *word;
            }
            transpose_bits(word);
        }

        let mut ahead = batch + size;
        let mut rest = any;
        while rest != 0 {
            let b = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            let block = &mut state[b & (MAX_BLOCKS - 1)];
            // The next batch, while this one is worked on.
            for _ in 0..AT_ONCE {
                task.prefetch(ahead);
                ahead += 1;
            }
            let mut spent = true;
            for lane in (0..LANES).step_by(V::LANES) {
                let (x, y) = centres.of::<V>(level, b, lane);
                let mut light = block.get::<V>(level, lane);
                for (w, words) in words.iter().enumerate() {
                    let mut word = words[b];
                    while word != 0 {
                        let i = word.trailing_zeros() as usize;
                        word &= word - 1;
                        light.pass::<DEGREE>(&entries[w * WORD + i], x, y, &rules);
                    }
                    if V::bits(light.unstopped.above(rules.stop)) == 0 {
                        break;
                    }
                }
                spent &= V::bits(light.unstopped.above(rules.stop)) == 0;
                block.set(lane, &light);
            }
            taking &= !(u64::from(spent) << b);
        }
        batch += size;
    }
    out.masks[batch.min(task.entries.len())..].fill(0);

    let mut stopped = 0;
    for (b, (block, open)) in state[..blocks].iter().zip(open).enumerate() {
        out.transmittance[b] = block.transmittance;
        out.end[b] = block.end;
        for k in 0..K {
            out.colors[k * blocks + b] = block.sums[k];
        }
        stopped += open.count_ones();
        for lane in (0..LANES).step_by(V::LANES) {
            stopped -= V::bits(block.unstopped.get::<V>(level, lane).above(rules.stop)).count_ones();
        }
    }
    *out.saturated = stopped as usize;
}

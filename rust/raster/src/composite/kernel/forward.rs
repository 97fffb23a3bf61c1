//! One tile, front to back.

use super::reach::BlockCentres;
use super::{AHEAD, Entry, LANES, Lanes, MAX_BLOCKS, PixelCentres, TileTask, WORD};
use crate::math::real::Real;
use crate::simd::transpose_bits;
use crate::simd::vector::Vector;

/// Splats loaded and composited at once: few enough to stay in the first-level cache, and a tile whose pixels have all
/// stopped loads no more.
const BATCH: usize = 2 * WORD;

/// Where forward writes a tile; pixels in block order. Earlier contents do not matter.
pub(crate) struct TileImage<'a, T> {
    /// For each of the kernel's channels, which may be more than are handled now, a plane of blocks.
    pub(crate) colors: &'a mut [Lanes<T>],
    /// Transmittance behind everything.
    pub(crate) transmittance: &'a mut [Lanes<T>],
    /// [`Real::ordinal`] of the place in the list at which a pixel stopped, or of the end of the list.
    pub(crate) end: &'a mut [Lanes<T>],
    /// Blocks that each listed splat reaches, without blocks that have stopped.
    pub(crate) masks: &'a mut [u16],
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
    threshold: V,
    max_alpha: V,
    stop: V,
}

impl<V: Vector, const K: usize> Light<V, K> {
    #[inline(always)]
    fn pass<const DEGREE: usize>(&mut self, entry: &Entry<V::Scalar, K>, x: V, y: V, rules: &Rules<V>) {
        let level = x.level();
        let (u, v) = entry.whitened(x, y);
        let raw = entry.raw_alpha::<V, DEGREE>(u, v);
        let hit = raw.at_least(rules.threshold);
        let alpha = raw.min(rules.max_alpha).keep(hit);
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

/// Composites one tile. `open` says which pixels of each block are to be rendered.
#[inline(always)]
pub(crate) fn forward_tile<V: Vector, const K: usize, const DEGREE: usize>(
    level: V::Level,
    task: &TileTask<'_, V::Scalar>,
    open: &[u16; MAX_BLOCKS],
    out: TileImage<'_, V::Scalar>,
) {
    let blocks = task.side * task.side;
    let block_centres = BlockCentres::new(task);
    let centres = PixelCentres::new(task);
    let rules = Rules {
        threshold: V::splat(level, task.threshold()),
        max_alpha: V::splat(level, task.limits.max_alpha),
        stop: V::splat(level, task.limits.min_transmittance),
    };
    let mut unstopped = [Lanes::ZERO; MAX_BLOCKS];
    let mut taking: u16 = 0;
    for block in 0..blocks {
        unstopped[block] = match open[block] {
            0xFFFF => Lanes::ONE,
            bits => Lanes(std::array::from_fn(|i| V::Scalar::of(f64::from(bits >> i & 1)))),
        };
        taking |= u16::from(open[block] != 0) << block;
    }
    out.transmittance[..blocks].fill(Lanes::ONE);
    out.end[..blocks].fill(Lanes::ZERO);
    for plane in out.colors.chunks_exact_mut(blocks).take(K) {
        plane.fill(Lanes::ZERO);
    }

    let mut entries = [Entry::<V::Scalar, K>::ZERO; BATCH];
    let mut batch = 0;
    while batch < task.entries.len() && taking != 0 {
        let size = BATCH.min(task.entries.len() - batch);
        let mut masks = [[0u16; WORD]; 2];
        for i in 0..size {
            task.prefetch(batch + i + AHEAD);
            let splat = &task.splats[task.entries[batch + i][0] as usize];
            masks[i / WORD][i % WORD] = block_centres.reached::<V>(level, splat, task.centre(splat)) & taking;
            entries[i] = Entry::load(task, batch + i);
        }
        out.masks[batch..batch + size].copy_from_slice(&masks.as_flattened()[..size]);
        let words = [transpose_bits(&masks[0]), transpose_bits(&masks[1])];

        let mut rest = taking;
        while rest != 0 {
            let block = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            let mut spent = true;
            for lane in (0..LANES).step_by(V::LANES) {
                let (x, y) = (
                    centres.x[block].get::<V>(level, lane),
                    centres.y[block].get::<V>(level, lane),
                );
                let mut light = Light::<V, K> {
                    unstopped: unstopped[block].get(level, lane),
                    transmittance: out.transmittance[block].get(level, lane),
                    end: out.end[block].get(level, lane),
                    sums: [V::splat(level, V::Scalar::ZERO); K],
                };
                for k in 0..K {
                    light.sums[k] = out.colors[k * blocks + block].get(level, lane);
                }
                for (w, words) in words.iter().enumerate() {
                    let mut word = words[block];
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
                unstopped[block].set(lane, light.unstopped);
                out.transmittance[block].set(lane, light.transmittance);
                out.end[block].set(lane, light.end);
                for k in 0..K {
                    out.colors[k * blocks + block].set(lane, light.sums[k]);
                }
            }
            taking &= !(u16::from(spent) << block);
        }
        batch += size;
    }
    out.masks[batch.min(task.entries.len())..].fill(0);

    let rendered: u32 = open[..blocks].iter().map(|bits| bits.count_ones()).sum();
    let mut unstopped_pixels = 0;
    for light in &unstopped[..blocks] {
        for lane in (0..LANES).step_by(V::LANES) {
            unstopped_pixels += V::bits(light.get::<V>(level, lane).above(rules.stop)).count_ones();
        }
    }
    *out.saturated = (rendered - unstopped_pixels) as usize;
}

//! The two inner loops: one tile forward, one tile backward.
//!
//! A tile is cut into blocks of 4×4 pixels, 16 lanes. Plain loops over the lanes are what the vectoriser turns into
//! SIMD; `dispatch` compiles these functions once per CPU feature level.
//!
//! Forward walks block by block, so that transmittance and colour stay in registers while a block's own list goes by.
//! Backward walks splat by splat, back to front, so that a splat's gradient is reduced once per tile, and recomputes
//! alpha: cheaper than storing it.

use std::hint::select_unpredictable as select;
use std::ops::{Index, IndexMut};

use crate::project::Splat;
use crate::real::{Arithmetic, Real};
use crate::settings::Limits;
use crate::tiles::padded_reach;

/// Pixels in a block.
pub(crate) const LANES: usize = 16;
/// Pixels along a side of a block.
pub(crate) const BLOCK: usize = 4;
/// Most blocks in a tile (tiles of 16×16).
pub(crate) const MAX_BLOCKS: usize = 16;
/// Most pixels in a tile.
pub(crate) const MAX_PIXELS: usize = LANES * MAX_BLOCKS;
/// Gradient values per (splat, tile) before those of the channels: h, hu, hv, huu, huv, hvv.
pub(crate) const MOMENTS: usize = 6;
/// Most channels composited at once.
pub(crate) const MAX_CHANNELS: usize = 8;

/// One value per pixel of a block, where a vector register finds it: a load that straddles two cache lines is slow.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(crate) struct Lanes<T>(pub(crate) [T; LANES]);

impl<T: Copy> Lanes<T> {
    #[inline(always)]
    pub(crate) fn splat(value: T) -> Self {
        Self([value; LANES])
    }
}

impl<T> Index<usize> for Lanes<T> {
    type Output = T;
    #[inline(always)]
    fn index(&self, lane: usize) -> &T {
        &self.0[lane]
    }
}

impl<T> IndexMut<usize> for Lanes<T> {
    #[inline(always)]
    fn index_mut(&mut self, lane: usize) -> &mut T {
        &mut self.0[lane]
    }
}

/// Where the values of channels come from: the caller's colours, then camera z.
#[derive(Clone, Copy)]
pub(crate) struct Channels<'a, T> {
    pub(crate) colors: &'a [T],
    /// Values per Gaussian in `colors`.
    pub(crate) stride: usize,
    /// Channels composited: `stride`, 1 more for depth after colours, or 1 for depth alone.
    pub(crate) total: usize,
    /// Channels of `colors` that are composited: all or none.
    pub(crate) colored: usize,
}

/// One tile's work: everything but the outputs.
#[derive(Clone, Copy)]
pub(crate) struct TileTask<'a, T> {
    /// Top-left pixel.
    pub(crate) origin: (usize, usize),
    /// Blocks along a side.
    pub(crate) side: usize,
    /// Depth ranks of the tile's splats, front to back.
    pub(crate) ranks: &'a [u32],
    pub(crate) splats: &'a [Splat<T>],
    /// Gaussian of each rank.
    pub(crate) ids: &'a [u32],
    pub(crate) channels: Channels<'a, T>,
    /// First of the channels handled now.
    pub(crate) first: usize,
    pub(crate) limits: &'a Limits<T>,
}

/// A splat in tile coordinates with K channel values.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry<T, const K: usize> {
    x: T,
    y: T,
    w11: T,
    w12: T,
    w22: T,
    opacity: T,
    values: [T; K],
}

impl<T: Real, const K: usize> Default for Entry<T, K> {
    fn default() -> Self {
        let [x, y, w11, w12, w22, opacity] = [T::ZERO; 6];
        Self {
            x,
            y,
            w11,
            w12,
            w22,
            opacity,
            values: [T::ZERO; K],
        }
    }
}

impl<T: Real, const K: usize> Entry<T, K> {
    #[inline(always)]
    fn load(task: &TileTask<'_, T>, rank: u32) -> (Self, T) {
        let splat = &task.splats[rank as usize];
        let mut values = [T::ZERO; K];
        let c = &task.channels;
        let start = task.ids[rank as usize] as usize * c.stride;
        for (k, value) in values.iter_mut().enumerate() {
            let channel = task.first + k;
            if channel < c.colored {
                *value = c.colors[start + channel];
            } else if channel < c.total {
                *value = splat.depth;
            }
        }
        let entry = Self {
            x: splat.x - T::of(task.origin.0 as f64),
            y: splat.y - T::of(task.origin.1 as f64),
            w11: splat.w11,
            w12: splat.w12,
            w22: splat.w22,
            opacity: splat.opacity,
            values,
        };
        (entry, splat.reach)
    }
}

/// Pixel centres of block 0 relative to its corner.
#[inline(always)]
fn lane_centres<T: Real>() -> (Lanes<T>, Lanes<T>) {
    (
        Lanes(std::array::from_fn(|i| T::of((i % BLOCK) as f64 + 0.5))),
        Lanes(std::array::from_fn(|i| T::of((i / BLOCK) as f64 + 0.5))),
    )
}

/// Corner of a block relative to its tile.
#[inline(always)]
fn block_corner<T: Real>(block: usize, side: usize) -> (T, T) {
    (
        T::of((block % side * BLOCK) as f64),
        T::of((block / side * BLOCK) as f64),
    )
}

/// First pixel centres of every block of a tile, for [`reached_blocks`].
struct BlockCentres<T> {
    x: Lanes<T>,
    y: Lanes<T>,
    /// The blocks that exist.
    mask: u16,
}

impl<T: Real> BlockCentres<T> {
    #[inline(always)]
    fn new(side: usize) -> Self {
        Self {
            x: Lanes(std::array::from_fn(|b| T::of((b % side * BLOCK) as f64 + 0.5))),
            y: Lanes(std::array::from_fn(|b| T::of((b / side * BLOCK) as f64 + 0.5))),
            mask: ((1u32 << (side * side)) - 1) as u16,
        }
    }
}

/// The blocks whose pixel centres' bounding box meets the ellipse {u² + v² ≤ reach}: exact, 16 blocks at once.
///
/// The least of the form over a box that does not hold the centre lies on one of the two edges that face it.
#[inline(always)]
fn reached_blocks<T: Real, A: Arithmetic, const K: usize>(
    entry: &Entry<T, K>,
    reach: T,
    centres: &BlockCentres<T>,
) -> u16 {
    let span = T::of(BLOCK as f64 - 1.0);
    // On a vertical line the form is least at dy = −(w11 w12 / (w12² + w22²)) dx, on a horizontal one at dx = −(w12/w11) dy.
    let down = -(entry.w11 * entry.w12) / (entry.w12 * entry.w12 + entry.w22 * entry.w22);
    let across = -entry.w12 / entry.w11;
    let mut hit = [0u32; LANES];
    for b in 0..LANES {
        let left = centres.x[b] - entry.x;
        let top = centres.y[b] - entry.y;
        let (right, bottom) = (left + span, top + span);
        let near_x = left.greater(right.lesser(T::ZERO));
        let near_y = top.greater(bottom.lesser(T::ZERO));
        let y_on_edge = (down * near_x).limit(top, bottom);
        let x_on_edge = (across * near_y).limit(left, right);
        let u1 = A::mul_add(entry.w11, near_x, entry.w12 * y_on_edge);
        let v1 = entry.w22 * y_on_edge;
        let u2 = A::mul_add(entry.w11, x_on_edge, entry.w12 * near_y);
        let v2 = entry.w22 * near_y;
        let least = A::mul_add(u1, u1, v1 * v1).lesser(A::mul_add(u2, u2, v2 * v2));
        hit[b] = u32::from(least <= reach) << b;
    }
    let mut mask = 0;
    for bit in hit {
        mask |= bit;
    }
    mask as u16 & centres.mask
}

/// What forward leaves of a tile; pixels in block order.
pub(crate) struct TileImage<'a, T> {
    /// Channel-major: channel k of pixel p is `colors[k · pixels + p]`, for the channels handled now.
    pub(crate) colors: &'a mut [T],
    /// Transmittance behind everything.
    pub(crate) transmittance: &'a mut [T],
    /// One more than the list index of the last splat that contributed.
    pub(crate) last: &'a mut [u32],
    /// Blocks that each listed splat reaches.
    pub(crate) masks: &'a mut [u16],
}

/// Splats loaded and composited at once: few enough to stay in the first cache, and a tile that is spent loads no more.
const BATCH: usize = 128;
/// Splats composited between two looks at whether a block is spent.
const STRIDE: usize = 8;

/// A block of pixels while light goes through it.
#[derive(Clone, Copy)]
struct Light<T, const K: usize> {
    /// Transmittance of a pixel that still takes light, 0 for one that has stopped.
    live: Lanes<T>,
    transmittance: Lanes<T>,
    last: Lanes<u32>,
    sums: [Lanes<T>; K],
}

impl<T: Real, const K: usize> Light<T, K> {
    #[inline(always)]
    fn spent(&self) -> bool {
        let mut taking = 0;
        for t in self.live.0 {
            taking += u32::from(t > T::ZERO);
        }
        taking == 0
    }
}

/// Composites one tile. `open` says which pixels are to be rendered.
#[inline(always)]
pub(crate) fn forward_tile<T: Real, A: Arithmetic, const K: usize>(
    task: &TileTask<'_, T>,
    open: &[bool; MAX_PIXELS],
    out: TileImage<'_, T>,
) {
    let blocks = task.side * task.side;
    let pixels = blocks * LANES;
    let centres = BlockCentres::<T>::new(task.side);
    let (lane_x, lane_y) = lane_centres::<T>();
    let (threshold, max_alpha, stop) = (
        task.limits.alpha_threshold,
        task.limits.max_alpha,
        task.limits.min_transmittance,
    );
    let mut lights = [Light {
        live: Lanes::splat(T::ZERO),
        transmittance: Lanes::splat(T::ONE),
        last: Lanes::splat(0u32),
        sums: [Lanes::splat(T::ZERO); K],
    }; MAX_BLOCKS];
    let mut taking: u16 = 0;
    for block in 0..blocks {
        for i in 0..LANES {
            lights[block].live[i] = if open[block * LANES + i] { T::ONE } else { T::ZERO };
        }
        taking |= u16::from(!lights[block].spent()) << block;
    }

    let mut entries = [Entry::<T, K>::default(); BATCH];
    for (batch, (ranks, masks)) in task
        .ranks
        .chunks(BATCH)
        .zip(out.masks.chunks_mut(BATCH))
        .enumerate()
    {
        for (index, &rank) in ranks.iter().enumerate() {
            let (entry, reach) = Entry::load(task, rank);
            masks[index] = reached_blocks::<T, A, K>(&entry, padded_reach(reach), &centres);
            entries[index] = entry;
        }
        let mut rest = taking;
        while rest != 0 {
            let block = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            // The block's own list, appended to without branches.
            let mut list = [0u8; BATCH];
            let mut length = 0;
            for (index, mask) in masks.iter().enumerate() {
                list[length & (BATCH - 1)] = index as u8;
                length += usize::from((mask >> block) & 1);
            }
            let (corner_x, corner_y) = block_corner::<T>(block, task.side);
            let mut light = lights[block];
            for chunk in list[..length].chunks(STRIDE) {
                for &index in chunk {
                    let entry = entries[usize::from(index) & (BATCH - 1)];
                    let place = (batch * BATCH + usize::from(index) + 1) as u32;
                    let (x, y) = (entry.x - corner_x, entry.y - corner_y);
                    for i in 0..LANES {
                        let dx = lane_x[i] - x;
                        let dy = lane_y[i] - y;
                        let u = A::mul_add(entry.w11, dx, entry.w12 * dy);
                        let v = entry.w22 * dy;
                        let falloff = (-A::mul_add(u, u, v * v)).exp2_of_nonpositive::<A>();
                        let alpha = (entry.opacity * falloff).lesser(max_alpha);
                        let hit = alpha >= threshold;
                        let weight = select(hit, alpha * light.live[i], T::ZERO);
                        let next = light.live[i] - weight;
                        let on = next > stop;
                        let weight = select(on, weight, T::ZERO);
                        light.live[i] = select(on, next, T::ZERO);
                        light.transmittance[i] = select(on, next, light.transmittance[i]);
                        light.last[i] = select(on & hit, place, light.last[i]);
                        for k in 0..K {
                            light.sums[k][i] = A::mul_add(weight, entry.values[k], light.sums[k][i]);
                        }
                    }
                }
                if light.spent() {
                    taking &= !(1 << block);
                    break;
                }
            }
            lights[block] = light;
        }
        if taking == 0 {
            break;
        }
    }

    for (block, light) in lights[..blocks].iter().enumerate() {
        let first = block * LANES;
        out.transmittance[first..first + LANES].copy_from_slice(&light.transmittance.0);
        out.last[first..first + LANES].copy_from_slice(&light.last.0);
        for (plane, sum) in out.colors.chunks_exact_mut(pixels).zip(&light.sums) {
            plane[first..first + LANES].copy_from_slice(&sum.0);
        }
    }
}

/// One value per pixel of a tile.
pub(crate) type TilePlane<T> = [Lanes<T>; MAX_BLOCKS];

/// What backward needs of a tile's pixels, in block order.
pub(crate) struct TileCotangents<'a, T> {
    pub(crate) transmittance: &'a [T],
    pub(crate) last: &'a [u32],
    pub(crate) masks: &'a [u16],
    /// Gradients of the channels handled now, channel-major.
    pub(crate) v_values: &'a [TilePlane<T>; MAX_CHANNELS],
    /// Gradient of the final transmittance, from alpha and background.
    pub(crate) v_transmittance: &'a TilePlane<T>,
}

/// The sum over lanes, by halves. Not inlined: next to its callers' loops it gets vectorised across sums, with gathers.
#[inline(never)]
fn horizontal_sum<T: Real>(lanes: &Lanes<T>) -> T {
    let eight: [T; 8] = std::array::from_fn(|i| lanes[i] + lanes[i + 8]);
    let four: [T; 4] = std::array::from_fn(|i| eight[i] + eight[i + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}

/// Adds, for every splat of the tile, its moments and the gradients of its channels to its slot
/// (`stride` values each: the moments, then all channels).
#[inline(always)]
pub(crate) fn backward_tile<T: Real, A: Arithmetic, const K: usize>(
    task: &TileTask<'_, T>,
    pixels: &TileCotangents<'_, T>,
    slots: &mut [T],
    stride: usize,
) {
    let blocks = task.side * task.side;
    let used = (task.channels.total - task.first).min(K);
    let (lane_x, lane_y) = lane_centres::<T>();
    let mut block_last = [0u32; MAX_BLOCKS];
    let mut transmittance = [Lanes::splat(T::ONE); MAX_BLOCKS];
    // Σ over what lies behind of weight · value · v, plus the background's part: what occlusion takes away.
    let mut behind = [Lanes::splat(T::ZERO); MAX_BLOCKS];
    let mut last = [Lanes::splat(0u32); MAX_BLOCKS];
    for block in 0..blocks {
        for i in 0..LANES {
            let p = block * LANES + i;
            last[block][i] = pixels.last[p];
            block_last[block] = block_last[block].max(pixels.last[p]);
            transmittance[block][i] = pixels.transmittance[p];
            behind[block][i] = pixels.transmittance[p] * pixels.v_transmittance[block][i];
        }
    }
    let deepest = block_last.iter().copied().max().unwrap_or(0);
    let (threshold, max_alpha) = (task.limits.alpha_threshold, task.limits.max_alpha);

    for index in (0..deepest).rev() {
        let mut rest = pixels.masks[index as usize];
        if rest == 0 {
            continue;
        }
        let (entry, _) = Entry::<T, K>::load(task, task.ranks[index as usize]);
        let mut moments: [Lanes<T>; MOMENTS] = [Lanes::splat(T::ZERO); MOMENTS];
        let mut v_values: [Lanes<T>; K] = [Lanes::splat(T::ZERO); K];
        while rest != 0 {
            let block = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            if index >= block_last[block] {
                continue;
            }
            let (corner_x, corner_y) = block_corner::<T>(block, task.side);
            let (x, y) = (entry.x - corner_x, entry.y - corner_y);
            let v_pixels: [&Lanes<T>; K] = std::array::from_fn(|k| &pixels.v_values[k][block]);
            let (transmittance, behind, last) = (&mut transmittance[block], &mut behind[block], &last[block]);
            for i in 0..LANES {
                let dx = lane_x[i] - x;
                let dy = lane_y[i] - y;
                let u = A::mul_add(entry.w11, dx, entry.w12 * dy);
                let v = entry.w22 * dy;
                let falloff = (-A::mul_add(u, u, v * v)).exp2_of_nonpositive::<A>();
                let raw = entry.opacity * falloff;
                let limited = raw.lesser(max_alpha);
                let on = (limited >= threshold) & (index < last[i]);
                let alpha = select(on, limited, T::ZERO);
                let reciprocal = (T::ONE - alpha).reciprocal::<A>();
                let before = transmittance[i] * reciprocal;
                let weight = alpha * before;
                let mut value = entry.values[0] * v_pixels[0][i];
                for k in 1..K {
                    value = A::mul_add(entry.values[k], v_pixels[k][i], value);
                }
                let v_alpha = A::mul_add(before, value, -(behind[i] * reciprocal));
                let h = if on & (raw <= max_alpha) {
                    v_alpha * falloff
                } else {
                    T::ZERO
                };
                transmittance[i] = before;
                behind[i] = A::mul_add(weight, value, behind[i]);
                let (hu, hv) = (h * u, h * v);
                moments[0][i] += h;
                moments[1][i] += hu;
                moments[2][i] += hv;
                moments[3][i] = A::mul_add(hu, u, moments[3][i]);
                moments[4][i] = A::mul_add(hu, v, moments[4][i]);
                moments[5][i] = A::mul_add(hv, v, moments[5][i]);
                for k in 0..K {
                    v_values[k][i] = A::mul_add(weight, v_pixels[k][i], v_values[k][i]);
                }
            }
        }
        let moments: [T; MOMENTS] = std::array::from_fn(|m| horizontal_sum(&moments[m]));
        let v_values: [T; K] = std::array::from_fn(|k| horizontal_sum(&v_values[k]));
        let slot = &mut slots[index as usize * stride..][..stride];
        for (sum, v) in slot.iter_mut().zip(moments) {
            *sum += v;
        }
        for (sum, v) in slot[MOMENTS + task.first..][..used].iter_mut().zip(v_values) {
            *sum += v;
        }
    }
}

//! All tiles of a view: front-to-back compositing, and its vjp into one slot per (tile, splat).

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::dispatch::{self, SimdLevel};
use crate::kernel::{
    ABSOLUTES, BLOCK, Channels, LANES, Lanes, MAX_BLOCKS, MAX_CHANNELS, MAX_SIDE, MOMENTS, TileCotangents,
    TileImage, TilePlane, TileTask,
};
use crate::pool::{Buffers, Pooled, bytes_of, stale};
use crate::project::Splat;
use crate::real::Real;
use crate::settings::Limits;
use crate::tiles::{TileBins, TileGrid};

/// Expected depth divides by alpha, or by this where there is hardly any; gsplat's constant.
const LEAST_ALPHA: f64 = 1e-10;

/// What the backward pass needs of the composited tiles. Tile-major, a block of pixels in each `Lanes`.
#[derive(Debug)]
pub(crate) struct Canvas<T> {
    transmittance: Vec<Lanes<T>>,
    /// See [`TileImage`].
    end: Vec<Lanes<T>>,
    /// Blocks reached, per entry of `TileBins::ranks`.
    masks: Vec<u16>,
    /// Accumulated depth where the image has expected depth, else empty.
    depths: Vec<Lanes<T>>,
    /// Pixels at which the light ended before the list did.
    pub(crate) saturated: usize,
}

/// What all tiles of a view share.
#[derive(Clone, Copy)]
pub(crate) struct Scene<'a, T> {
    pub(crate) grid: TileGrid,
    pub(crate) bins: &'a TileBins,
    pub(crate) splats: &'a [Splat<T>],
    pub(crate) channels: Channels<'a, T>,
    pub(crate) expected_depth: bool,
    pub(crate) background: Option<&'a [T]>,
    pub(crate) pixel_mask: Option<&'a [bool]>,
    pub(crate) limits: &'a Limits<T>,
}

impl<T> Default for Canvas<T> {
    fn default() -> Self {
        Self {
            transmittance: Vec::new(),
            end: Vec::new(),
            masks: Vec::new(),
            depths: Vec::new(),
            saturated: 0,
        }
    }
}

impl<T: Real> Buffers for Canvas<T> {
    fn bytes(&self) -> usize {
        let lanes = [&self.transmittance, &self.end, &self.depths];
        lanes.map(bytes_of).iter().sum::<usize>() + bytes_of(&self.masks)
    }
}

impl<'a, T: Real> Scene<'a, T> {
    fn task(&self, tile: usize) -> TileTask<'a, T> {
        TileTask {
            origin: self.grid.origin(tile),
            side: self.grid.tile_size / BLOCK,
            ranks: &self.bins.ranks[self.bins.offsets[tile] as usize..self.bins.offsets[tile + 1] as usize],
            splats: self.splats,
            channels: self.channels,
            first: 0,
            limits: self.limits,
        }
    }

    fn blocks(&self) -> usize {
        self.grid.pixels_per_tile() / LANES
    }

    /// Calls `f` with (block in the tile, first lane, index in the image, pixels) for each row of each of a tile's
    /// blocks, as far as it lies in the image.
    #[inline(always)]
    fn for_block_rows(&self, tile: usize, mut f: impl FnMut(usize, usize, usize, usize)) {
        let (left, top) = self.grid.origin(tile);
        let side = self.grid.tile_size / BLOCK;
        for y in 0..self.grid.tile_size.min(self.grid.height - top) {
            for column in 0..side {
                let x = left + column * BLOCK;
                if x < self.grid.width {
                    f(
                        y / BLOCK * side + column,
                        y % BLOCK * BLOCK,
                        (top + y) * self.grid.width + x,
                        BLOCK.min(self.grid.width - x),
                    );
                }
            }
        }
    }

    /// The pixels of each block that are to be rendered.
    fn open_pixels(&self, tile: usize) -> [u16; MAX_BLOCKS] {
        let mut open = [0u16; MAX_BLOCKS];
        self.for_block_rows(tile, |block, lane, pixel, count| {
            for i in 0..count {
                let wanted = self.pixel_mask.is_none_or(|mask| mask[pixel + i]);
                open[block] |= u16::from(wanted) << (lane + i);
            }
        });
        open
    }

    /// The background of a channel; depth has none.
    fn background(&self, channel: usize) -> T {
        match self.background {
            Some(values) if channel < self.channels.colored => values[channel],
            _ => T::ZERO,
        }
    }
}

/// Consecutive tiles of one row of tiles: their rows of the image, and their part of the canvas.
struct Strip<'a, T> {
    tile: usize,
    tiles: usize,
    colors: [&'a mut [T]; MAX_SIDE],
    alphas: [&'a mut [T]; MAX_SIDE],
    transmittance: &'a mut [Lanes<T>],
    end: &'a mut [Lanes<T>],
    depths: &'a mut [Lanes<T>],
    masks: &'a mut [u16],
}

/// Takes the first values off, or all there are: what nobody asked for is empty.
fn cut<'a, U>(slice: &mut &'a mut [U], at: usize) -> &'a mut [U] {
    let at = at.min(slice.len());
    let (head, tail) = std::mem::take(slice).split_at_mut(at);
    *slice = tail;
    head
}

impl<'a, T: Real> Strip<'a, T> {
    /// Takes the first `tiles` tiles off.
    fn take(&mut self, scene: &Scene<'_, T>, tiles: usize) -> Self {
        let (blocks, offsets) = (scene.blocks(), &scene.bins.offsets);
        let pixels = tiles * scene.grid.tile_size;
        let total = scene.channels.total;
        let entries = offsets[self.tile + tiles] - offsets[self.tile];
        let head = Self {
            tile: self.tile,
            tiles,
            colors: std::array::from_fn(|y| cut(&mut self.colors[y], pixels * total)),
            alphas: std::array::from_fn(|y| cut(&mut self.alphas[y], pixels)),
            transmittance: cut(&mut self.transmittance, tiles * blocks),
            end: cut(&mut self.end, tiles * blocks),
            depths: cut(&mut self.depths, tiles * blocks),
            masks: cut(&mut self.masks, entries as usize),
        };
        self.tile += tiles;
        self.tiles -= tiles;
        head
    }

    fn halves(mut self, scene: &Scene<'_, T>) -> (Self, Option<Self>) {
        if self.tiles < 2 {
            return (self, None);
        }
        let head = self.take(scene, self.tiles / 2);
        (head, Some(self))
    }
}

/// Composites every tile over the background into the image.
pub(crate) fn composite<T: Real>(
    scene: &Scene<'_, T>,
    colors: &mut [T],
    alphas: &mut [T],
) -> Pooled<Canvas<T>> {
    let grid = &scene.grid;
    let blocks = grid.len() * scene.blocks();
    let total = scene.channels.total;
    let mut canvas = Pooled::<Canvas<T>>::take();
    let out = &mut *canvas;
    let mut rest = Strip {
        tile: 0,
        tiles: grid.len(),
        colors: Default::default(),
        alphas: Default::default(),
        transmittance: stale(&mut out.transmittance, blocks),
        end: stale(&mut out.end, blocks),
        depths: stale(&mut out.depths, if scene.expected_depth { blocks } else { 0 }),
        masks: stale(&mut out.masks, scene.bins.ranks.len()),
    };
    let strips: Vec<Strip<'_, T>> = colors
        .chunks_mut(grid.tile_size * grid.width * total)
        .zip(alphas.chunks_mut(grid.tile_size * grid.width))
        .map(|(colors, alphas)| {
            let mut strip = rest.take(scene, grid.columns);
            for (row, colors) in strip.colors.iter_mut().zip(colors.chunks_mut(grid.width * total)) {
                *row = colors;
            }
            for (row, alphas) in strip.alphas.iter_mut().zip(alphas.chunks_mut(grid.width)) {
                *row = alphas;
            }
            strip
        })
        .collect();
    let background: Vec<T> = (0..total).map(|channel| scene.background(channel)).collect();
    // The kernel for the last group may have a channel more than is left.
    let planes = || vec![Lanes::ZERO; (total + 1) * scene.blocks()];
    let saturated = AtomicUsize::new(0);
    strips
        .into_par_iter()
        .flat_map(|strip| rayon::iter::split(strip, |strip| strip.halves(scene)))
        .for_each_init(planes, |planes, mut strip| {
            while strip.tiles > 0 {
                let tile = strip.take(scene, 1);
                saturated.fetch_add(
                    composite_tile(scene, &background, planes, tile),
                    Ordering::Relaxed,
                );
            }
        });
    out.saturated = saturated.into_inner();
    canvas
}

/// Composites one tile; returns how many of its pixels are saturated.
fn composite_tile<T: Real>(
    scene: &Scene<'_, T>,
    background: &[T],
    planes: &mut [Lanes<T>],
    mut out: Strip<'_, T>,
) -> usize {
    let mut saturated = 0;
    let level = SimdLevel::detect();
    let blocks = scene.blocks();
    let total = scene.channels.total;
    let mut task = scene.task(out.tile);
    if task.ranks.is_empty() {
        planes.fill(Lanes::ZERO);
        out.transmittance.fill(Lanes::ONE);
        out.end.fill(Lanes::ZERO);
    } else {
        let open = scene.open_pixels(out.tile);
        while task.first < total {
            let tile_image = TileImage {
                colors: &mut planes[task.first * blocks..],
                transmittance: &mut *out.transmittance,
                end: &mut *out.end,
                masks: &mut *out.masks,
                // The same for every group of channels.
                saturated: &mut saturated,
            };
            dispatch::forward(level, &task, &open, tile_image);
            task.first += MAX_CHANNELS;
        }
    }
    if scene.expected_depth {
        out.depths
            .copy_from_slice(&planes[(total - 1) * blocks..total * blocks]);
    }
    match total {
        1 if !scene.expected_depth => write_colors::<T, 1>(scene, background, planes, &mut out),
        3 if !scene.expected_depth => write_colors::<T, 3>(scene, background, planes, &mut out),
        4 if !scene.expected_depth => write_colors::<T, 4>(scene, background, planes, &mut out),
        _ => write_tile(scene, background, planes, &mut out),
    }
    saturated
}

/// Writes a tile into its rows of the image: adds the background, divides expected depth by alpha.
fn write_tile<T: Real>(scene: &Scene<'_, T>, background: &[T], planes: &[Lanes<T>], out: &mut Strip<'_, T>) {
    let total = scene.channels.total;
    let (blocks, side) = (scene.blocks(), scene.grid.tile_size / BLOCK);
    for (y, (colors, alphas)) in out.colors.iter_mut().zip(&mut out.alphas).enumerate() {
        for (x, (values, alpha)) in colors.chunks_exact_mut(total).zip(alphas.iter_mut()).enumerate() {
            let block = y / BLOCK * side + x / BLOCK;
            let lane = y % BLOCK * BLOCK + x % BLOCK;
            let transmittance = out.transmittance[block].0[lane];
            for (channel, value) in values.iter_mut().enumerate() {
                *value = planes[channel * blocks + block].0[lane] + transmittance * background[channel];
            }
            *alpha = T::ONE - transmittance;
            if scene.expected_depth {
                values[total - 1] = values[total - 1] / alpha.greater(T::of(LEAST_ALPHA));
            }
        }
    }
}

/// [`write_tile`] for the usual numbers of channels and no division, a row of a block at a time.
fn write_colors<T: Real, const K: usize>(
    scene: &Scene<'_, T>,
    background: &[T],
    planes: &[Lanes<T>],
    out: &mut Strip<'_, T>,
) {
    let (blocks, side) = (scene.blocks(), scene.grid.tile_size / BLOCK);
    let background: [T; K] = std::array::from_fn(|k| background[k]);
    for (y, (colors, alphas)) in out.colors.iter_mut().zip(&mut out.alphas).enumerate() {
        let (first, row) = (y / BLOCK * side, y % BLOCK);
        let colors = colors.as_chunks_mut::<K>().0;
        for (block, (colors, alphas)) in (first..).zip(colors.chunks_mut(BLOCK).zip(alphas.chunks_mut(BLOCK)))
        {
            let transmittance = out.transmittance[block].rows()[row];
            let values: [[T; BLOCK]; K] = std::array::from_fn(|k| planes[k * blocks + block].rows()[row]);
            for (i, (color, alpha)) in colors.iter_mut().zip(alphas).enumerate() {
                for k in 0..K {
                    color[k] = values[k][i] + transmittance[i] * background[k];
                }
                *alpha = T::ONE - transmittance[i];
            }
        }
    }
}

/// The Gaussian at which half of each pixel's light is gone, by rows and columns: the last of those that more than
/// half reaches. −1 where nothing is seen.
pub(crate) fn medians<T: Real>(scene: &Scene<'_, T>, canvas: &Canvas<T>) -> Vec<i32> {
    let grid = &scene.grid;
    let (level, blocks) = (SimdLevel::detect(), scene.blocks());
    let mut ids = vec![-1; grid.width * grid.height];
    let rows = grid.tile_size * grid.width;
    ids.par_chunks_mut(rows).enumerate().for_each(|(row, ids)| {
        let mut places = [Lanes::ZERO; MAX_BLOCKS];
        for tile in row * grid.columns..(row + 1) * grid.columns {
            let task = scene.task(tile);
            if task.ranks.is_empty() {
                continue;
            }
            let list = scene.bins.offsets[tile] as usize..scene.bins.offsets[tile + 1] as usize;
            let end = &canvas.end[tile * blocks..(tile + 1) * blocks];
            dispatch::median(level, &task, &canvas.masks[list], end, &mut places);
            scene.for_block_rows(tile, |block, lane, pixel, count| {
                let own = &mut ids[pixel - row * rows..][..count];
                for (id, place) in own.iter_mut().zip(&places[block].0[lane..]) {
                    if let Some(place) = place.past_ordinal().checked_sub(1) {
                        *id = task.ranks[place as usize] as i32;
                    }
                }
            });
        }
    });
    ids
}

/// Gradients of an image.
#[derive(Clone, Copy)]
pub(crate) struct Cotangents<'a, T> {
    /// As the image: rows, columns, channels.
    pub(crate) colors: &'a [T],
    pub(crate) alphas: &'a [T],
}

/// `MOMENTS` + channels values per entry of `TileBins::ranks`, and `ABSOLUTES` if asked for.
#[derive(Debug)]
pub(crate) struct Slots<T>(Vec<T>);

impl<T> Slots<T> {
    pub(crate) fn values(&self) -> &[T] {
        &self.0
    }
}

impl<T> Default for Slots<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T: Real> Buffers for Slots<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.0)
    }
}

/// What the compositor's vjp yields.
#[derive(Debug)]
pub(crate) struct CompositeGradients<T: Real> {
    pub(crate) slots: Pooled<Slots<T>>,
    pub(crate) background: Vec<T>,
    /// Tiles whose incoming gradient was zero.
    pub(crate) tiles_skipped: usize,
}

/// Cuts a buffer into one piece per tile, `stride` values per entry of the tile's list.
fn pieces_by_tile<'a, U>(mut buffer: &'a mut [U], offsets: &[u32], stride: usize) -> Vec<&'a mut [U]> {
    offsets
        .windows(2)
        .map(|pair| cut(&mut buffer, (pair[1] - pair[0]) as usize * stride))
        .collect()
}

/// The vjp of [`composite`].
pub(crate) fn composite_vjp<T: Real>(
    scene: &Scene<'_, T>,
    canvas: &Canvas<T>,
    v: Cotangents<'_, T>,
    absolute: bool,
) -> CompositeGradients<T> {
    let level = SimdLevel::detect();
    let blocks = scene.blocks();
    let total = scene.channels.total;
    let stride = MOMENTS + total + if absolute { ABSOLUTES } else { 0 };
    let mut slots = Pooled::<Slots<T>>::take();
    let values = stale(&mut slots.0, scene.bins.ranks.len() * stride);
    let mut backgrounds = vec![T::ZERO; scene.grid.len() * total];
    let tiles_skipped = AtomicUsize::new(0);
    (
        pieces_by_tile(values, &scene.bins.offsets, stride),
        backgrounds.par_chunks_mut(total),
    )
        .into_par_iter()
        .enumerate()
        .for_each_init(TileGradients::new, |incoming, (tile, (slots, v_background))| {
            let mut task = scene.task(tile);
            if task.ranks.is_empty() && scene.background.is_none() {
                return;
            }
            let own = tile * blocks..(tile + 1) * blocks;
            let transmittance = &canvas.transmittance[own.clone()];
            let mut skipped = true;
            while task.first < total {
                let any = incoming.load(scene, canvas, tile, task.first, v);
                if scene.background.is_some() {
                    for k in 0..(total - task.first).min(MAX_CHANNELS) {
                        v_background[task.first + k] = dot(transmittance, &incoming.v_values[k]);
                    }
                }
                if !any {
                    clear(slots, stride, task.first, total);
                } else if !task.ranks.is_empty() {
                    skipped = false;
                    let cotangents = TileCotangents {
                        transmittance,
                        end: &canvas.end[own.clone()],
                        masks: &canvas.masks
                            [scene.bins.offsets[tile] as usize..scene.bins.offsets[tile + 1] as usize],
                        v_values: &incoming.v_values,
                        v_transmittance: &incoming.v_transmittance,
                    };
                    dispatch::backward(level, &task, &cotangents, slots, stride, absolute);
                }
                task.first += MAX_CHANNELS;
            }
            if skipped && !task.ranks.is_empty() {
                tiles_skipped.fetch_add(1, Ordering::Relaxed);
            }
        });
    let mut background = vec![T::ZERO; scene.channels.colored];
    for tile in backgrounds.chunks_exact(total) {
        for (sum, &v) in background.iter_mut().zip(tile) {
            *sum += v;
        }
    }
    CompositeGradients {
        slots,
        background,
        tiles_skipped: tiles_skipped.into_inner(),
    }
}

/// Zeroes what a kernel would have written for the channels of the group that starts with `first`.
fn clear<T: Real>(slots: &mut [T], stride: usize, first: usize, total: usize) {
    if first == 0 {
        slots.fill(T::ZERO);
        return;
    }
    for slot in slots.chunks_exact_mut(stride) {
        slot[MOMENTS + first..MOMENTS + total.min(first + MAX_CHANNELS)].fill(T::ZERO);
    }
}

fn dot<T: Real>(a: &[Lanes<T>], b: &[Lanes<T>]) -> T {
    let products = a
        .iter()
        .zip(b)
        .flat_map(|(a, b)| a.0.iter().zip(&b.0).map(|(&a, &b)| a * b));
    products.sum()
}

/// The incoming gradients of one tile, for one group of channels.
struct TileGradients<T> {
    v_values: [TilePlane<T>; MAX_CHANNELS],
    v_transmittance: TilePlane<T>,
}

impl<T: Real> TileGradients<T> {
    fn new() -> Self {
        Self {
            v_values: [[Lanes::ZERO; MAX_BLOCKS]; MAX_CHANNELS],
            v_transmittance: [Lanes::ZERO; MAX_BLOCKS],
        }
    }

    /// Reads the channels from `first` on; whether any gradient is not zero.
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
        if whole && !scene.expected_depth && scene.background.is_none() && first == 0 {
            match total {
                1 => return self.load_whole::<1>(scene, tile, v),
                3 => return self.load_whole::<3>(scene, tile, v),
                4 => return self.load_whole::<4>(scene, tile, v),
                _ => {}
            }
        }
        let used = (total - first).min(MAX_CHANNELS);
        let background: [T; MAX_CHANNELS] = std::array::from_fn(|k| scene.background(first + k));
        *self = Self::new();
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

    /// A tile within the image, all of whose K channels are colours over black or plain depth.
    fn load_whole<const K: usize>(
        &mut self,
        scene: &Scene<'_, T>,
        tile: usize,
        v: Cotangents<'_, T>,
    ) -> bool {
        let mut any = false;
        scene.for_block_rows(tile, |block, lane, pixel, _| {
            let colors = &v.colors[pixel * K..(pixel + BLOCK) * K];
            let alphas = &v.alphas[pixel..pixel + BLOCK];
            for i in 0..BLOCK {
                for k in 0..K {
                    self.v_values[k][block].0[lane + i] = colors[i * K + k];
                }
                self.v_transmittance[block].0[lane + i] = -alphas[i];
            }
            for &value in colors {
                any |= value != T::ZERO;
            }
            for &value in alphas {
                any |= value != T::ZERO;
            }
        });
        any
    }
}

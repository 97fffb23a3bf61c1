//! All tiles of a view: front-to-back compositing, and its vjp into one slot per (tile, splat).

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::dispatch::{self, SimdLevel};
use crate::kernel::{
    BLOCK, Channels, LANES, Lanes, MAX_BLOCKS, MAX_CHANNELS, MAX_PIXELS, MOMENTS, TileCotangents,
    TileImage, TilePlane, TileTask,
};
use crate::project::Splat;
use crate::real::Real;
use crate::settings::Limits;
use crate::tiles::{TileBins, TileGrid};

/// Expected depth divides by alpha, or by this where there is hardly any; gsplat's constant.
const LEAST_ALPHA: f64 = 1e-10;

/// The composited tiles, kept for the backward pass. Tile-major; pixels of a tile in block order.
#[derive(Debug)]
pub(crate) struct Canvas<T> {
    /// Channel planes of each tile.
    colors: Vec<T>,
    transmittance: Vec<T>,
    last: Vec<u32>,
    /// Blocks reached, per entry of `TileBins::ranks`.
    masks: Vec<u16>,
}

/// What all tiles of a view share.
#[derive(Clone, Copy)]
pub(crate) struct Scene<'a, T> {
    pub(crate) grid: TileGrid,
    pub(crate) bins: &'a TileBins,
    pub(crate) splats: &'a [Splat<T>],
    pub(crate) ids: &'a [u32],
    pub(crate) channels: Channels<'a, T>,
    pub(crate) expected_depth: bool,
    pub(crate) background: Option<&'a [T]>,
    pub(crate) pixel_mask: Option<&'a [bool]>,
    pub(crate) limits: &'a Limits<T>,
}

impl<'a, T: Real> Scene<'a, T> {
    fn task(&self, tile: usize) -> TileTask<'a, T> {
        TileTask {
            origin: self.grid.origin(tile),
            side: self.grid.tile_size / BLOCK,
            ranks: &self.bins.ranks
                [self.bins.offsets[tile] as usize..self.bins.offsets[tile + 1] as usize],
            splats: self.splats,
            ids: self.ids,
            channels: self.channels,
            first: 0,
            limits: self.limits,
        }
    }

    /// Calls `f` with (index in the tile, index in the image) of every pixel of a tile that is to be rendered.
    fn for_pixels(&self, tile: usize, mut f: impl FnMut(usize, usize)) {
        let (left, top) = self.grid.origin(tile);
        let (width, height) = (self.grid.width, self.grid.height);
        let side = self.grid.tile_size / BLOCK;
        for p in 0..self.grid.pixels_per_tile() {
            let (block, lane) = (p / LANES, p % LANES);
            let x = left + block % side * BLOCK + lane % BLOCK;
            let y = top + block / side * BLOCK + lane / BLOCK;
            if x < width && y < height {
                let pixel = y * width + x;
                if self.pixel_mask.is_none_or(|mask| mask[pixel]) {
                    f(p, pixel);
                }
            }
        }
    }

    /// The background of a channel; depth has none.
    fn background(&self, channel: usize) -> T {
        match self.background {
            Some(values) if channel < self.channels.colored => values[channel],
            _ => T::ZERO,
        }
    }
}

/// Cuts a buffer into one piece per tile, `stride` values per entry of the tile's list.
fn pieces_per_tile<'a, U>(
    mut buffer: &'a mut [U],
    offsets: &[u32],
    stride: usize,
) -> Vec<&'a mut [U]> {
    offsets
        .windows(2)
        .map(|pair| {
            let (piece, rest) =
                std::mem::take(&mut buffer).split_at_mut((pair[1] - pair[0]) as usize * stride);
            buffer = rest;
            piece
        })
        .collect()
}

/// Composites every tile.
pub(crate) fn composite<T: Real>(scene: &Scene<'_, T>) -> Canvas<T> {
    let level = SimdLevel::detect();
    let pixels = scene.grid.pixels_per_tile();
    let tiles = scene.grid.len();
    let total = scene.channels.total;
    let mut canvas = Canvas {
        colors: vec![T::ZERO; tiles * pixels * total],
        transmittance: vec![T::ONE; tiles * pixels],
        last: vec![0; tiles * pixels],
        masks: vec![0; scene.bins.ranks.len()],
    };
    let masks = pieces_per_tile(&mut canvas.masks, &scene.bins.offsets, 1);
    (
        masks,
        canvas.colors.par_chunks_mut(pixels * total),
        canvas.transmittance.par_chunks_mut(pixels),
        canvas.last.par_chunks_mut(pixels),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(tile, (masks, colors, transmittance, last))| {
            if masks.is_empty() {
                return;
            }
            let mut open = [false; MAX_PIXELS];
            scene.for_pixels(tile, |p, _| open[p] = true);
            let mut task = scene.task(tile);
            while task.first < total {
                let out = TileImage {
                    colors: &mut colors[task.first * pixels..],
                    transmittance,
                    last,
                    masks,
                };
                dispatch::forward(level, &task, &open, out);
                task.first += MAX_CHANNELS;
            }
        });
    canvas
}

/// Writes the canvas as an image: adds the background, divides expected depth by alpha.
pub(crate) fn write_image<T: Real>(
    scene: &Scene<'_, T>,
    canvas: &Canvas<T>,
    colors: &mut [T],
    alphas: &mut [T],
) {
    let grid = &scene.grid;
    let total = scene.channels.total;
    let (pixels, side) = (grid.pixels_per_tile(), grid.tile_size / BLOCK);
    let background: Vec<T> = (0..total)
        .map(|channel| scene.background(channel))
        .collect();
    (
        colors.par_chunks_mut(grid.width * total),
        alphas.par_chunks_mut(grid.width),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(y, (colors, alphas))| {
            for x in (0..grid.width).step_by(BLOCK) {
                let tile = y / grid.tile_size * grid.columns + x / grid.tile_size;
                let block = y % grid.tile_size / BLOCK * side + x % grid.tile_size / BLOCK;
                let p = block * LANES + y % BLOCK * BLOCK;
                let planes = &canvas.colors[tile * pixels * total..][..pixels * total];
                for i in 0..BLOCK.min(grid.width - x) {
                    let transmittance = canvas.transmittance[tile * pixels + p + i];
                    let pixel = &mut colors[(x + i) * total..][..total];
                    for (channel, value) in pixel.iter_mut().enumerate() {
                        *value =
                            planes[channel * pixels + p + i] + transmittance * background[channel];
                    }
                    let alpha = T::ONE - transmittance;
                    alphas[x + i] = alpha;
                    if scene.expected_depth {
                        pixel[total - 1] = pixel[total - 1] / alpha.greater(T::of(LEAST_ALPHA));
                    }
                }
            }
        });
}

/// Gradients of an image.
#[derive(Clone, Copy)]
pub(crate) struct Cotangents<'a, T> {
    /// As the image: rows, columns, channels.
    pub(crate) colors: &'a [T],
    pub(crate) alphas: &'a [T],
}

/// What the compositor's vjp yields.
pub(crate) struct CompositeGradients<T> {
    /// `MOMENTS` + channels values per entry of `TileBins::ranks`.
    pub(crate) slots: Vec<T>,
    pub(crate) background: Vec<T>,
    /// Tiles whose incoming gradient was zero.
    pub(crate) tiles_skipped: usize,
}

/// The vjp of [`composite`] and [`write_image`].
pub(crate) fn composite_vjp<T: Real>(
    scene: &Scene<'_, T>,
    canvas: &Canvas<T>,
    v: Cotangents<'_, T>,
) -> CompositeGradients<T> {
    let level = SimdLevel::detect();
    let pixels = scene.grid.pixels_per_tile();
    let total = scene.channels.total;
    let stride = MOMENTS + total;
    let mut slots = vec![T::ZERO; scene.bins.ranks.len() * stride];
    let mut backgrounds = vec![T::ZERO; scene.grid.len() * total];
    let tiles_skipped = AtomicUsize::new(0);
    (
        pieces_per_tile(&mut slots, &scene.bins.offsets, stride),
        backgrounds.par_chunks_mut(total),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(tile, (slots, v_background))| {
            let mut task = scene.task(tile);
            if task.ranks.is_empty() && scene.background.is_none() {
                return;
            }
            let own = tile * pixels..(tile + 1) * pixels;
            let transmittance = &canvas.transmittance[own.clone()];
            let mut skipped = true;
            while task.first < total {
                let (v_values, v_transmittance, any) =
                    load_cotangents(scene, canvas, tile, task.first, v);
                for k in 0..(total - task.first).min(MAX_CHANNELS) {
                    v_background[task.first + k] = transmittance
                        .iter()
                        .zip(v_values[k].iter().flat_map(|lanes| &lanes.0))
                        .map(|(&t, &v)| t * v)
                        .sum();
                }
                if any && !task.ranks.is_empty() {
                    skipped = false;
                    let cotangents = TileCotangents {
                        transmittance,
                        last: &canvas.last[own.clone()],
                        masks: &canvas.masks[scene.bins.offsets[tile] as usize
                            ..scene.bins.offsets[tile + 1] as usize],
                        v_values: &v_values,
                        v_transmittance: &v_transmittance,
                    };
                    dispatch::backward(level, &task, &cotangents, slots, stride);
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

/// Gradients of the channels from `first` on and of the transmittance for one tile, and whether any is not zero.
fn load_cotangents<T: Real>(
    scene: &Scene<'_, T>,
    canvas: &Canvas<T>,
    tile: usize,
    first: usize,
    v: Cotangents<'_, T>,
) -> ([TilePlane<T>; MAX_CHANNELS], TilePlane<T>, bool) {
    let total = scene.channels.total;
    let pixels = scene.grid.pixels_per_tile();
    let used = (total - first).min(MAX_CHANNELS);
    let background: [T; MAX_CHANNELS] = std::array::from_fn(|k| scene.background(first + k));
    let zero = [Lanes::splat(T::ZERO); MAX_BLOCKS];
    let (mut v_values, mut v_transmittance) = ([zero; MAX_CHANNELS], zero);
    let mut any = false;
    let depth_plane = (tile * total + total - 1) * pixels;
    scene.for_pixels(tile, |p, pixel| {
        // Alpha is 1 − transmittance; it belongs to the first group of channels.
        let mut v_alpha = if first == 0 { v.alphas[pixel] } else { T::ZERO };
        let incoming = &v.colors[pixel * total + first..][..used];
        for k in 0..used {
            let mut value = incoming[k];
            if scene.expected_depth && first + k == total - 1 {
                let alpha = T::ONE - canvas.transmittance[tile * pixels + p];
                let least = T::of(LEAST_ALPHA);
                value = value / alpha.greater(least);
                if alpha > least {
                    v_alpha += -(value * (canvas.colors[depth_plane + p] / alpha));
                }
            }
            v_values[k][p / LANES][p % LANES] = value;
            v_transmittance[p / LANES][p % LANES] += value * background[k];
            any |= value != T::ZERO;
        }
        v_transmittance[p / LANES][p % LANES] += -v_alpha;
        any |= v_alpha != T::ZERO;
    });
    (v_values, v_transmittance, any)
}

//! All tiles of a view: front-to-back compositing, and its vjp into one slot per (tile, splat).

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::dispatch::{self, SimdLevel};
use crate::kernel::{
    BLOCK, Channels, LANES, Lanes, MAX_BLOCKS, MAX_CHANNELS, MAX_PIXELS, MOMENTS, TileCotangents, TileImage,
    TilePlane, TileTask,
};
use crate::project::Splat;
use crate::real::Real;
use crate::settings::Limits;
use crate::tiles::{TileBins, TileGrid};

/// Expected depth divides by alpha, or by this where there is hardly any; gsplat's constant.
const LEAST_ALPHA: f64 = 1e-10;

/// What the backward pass needs of the composited tiles. Tile-major; pixels of a tile in block order.
#[derive(Debug)]
pub(crate) struct Canvas<T> {
    transmittance: Vec<T>,
    last: Vec<u32>,
    /// Blocks reached, per entry of `TileBins::ranks`.
    masks: Vec<u16>,
    /// Accumulated depth where the image has expected depth, else empty.
    depths: Vec<T>,
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
            ranks: &self.bins.ranks[self.bins.offsets[tile] as usize..self.bins.offsets[tile + 1] as usize],
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

/// Cuts a buffer into one piece per group of `tiles` tiles, `stride` values per entry of the tiles' lists.
fn pieces_by_tile<'a, U>(
    mut buffer: &'a mut [U],
    offsets: &[u32],
    tiles: usize,
    stride: usize,
) -> Vec<&'a mut [U]> {
    let ends = offsets.iter().skip(tiles).step_by(tiles);
    let starts = offsets.iter().step_by(tiles);
    starts
        .zip(ends)
        .map(|(start, end)| {
            let size = (end - start) as usize * stride;
            let (piece, rest) = std::mem::take(&mut buffer).split_at_mut(size);
            buffer = rest;
            piece
        })
        .collect()
}

/// One row of tiles: its part of the image, which is contiguous, and of the canvas.
struct TileRow<'a, T> {
    colors: &'a mut [T],
    alphas: &'a mut [T],
    transmittance: &'a mut [T],
    last: &'a mut [u32],
    depths: &'a mut [T],
    masks: &'a mut [u16],
}

/// Composites every tile over the background into the image.
pub(crate) fn composite<T: Real>(scene: &Scene<'_, T>, colors: &mut [T], alphas: &mut [T]) -> Canvas<T> {
    let grid = &scene.grid;
    let pixels = grid.pixels_per_tile();
    let total = scene.channels.total;
    let mut canvas = Canvas {
        transmittance: vec![T::ONE; grid.len() * pixels],
        last: vec![0; grid.len() * pixels],
        masks: vec![0; scene.bins.ranks.len()],
        depths: vec![
            T::ZERO;
            if scene.expected_depth {
                grid.len() * pixels
            } else {
                0
            }
        ],
    };
    let image_row = grid.tile_size * grid.width;
    let canvas_row = grid.columns * pixels;
    let mut depths = canvas.depths.chunks_mut(canvas_row);
    let rows: Vec<TileRow<'_, T>> = pieces_by_tile(&mut canvas.masks, &scene.bins.offsets, grid.columns, 1)
        .into_iter()
        .zip(colors.chunks_mut(image_row * total))
        .zip(alphas.chunks_mut(image_row))
        .zip(canvas.transmittance.chunks_mut(canvas_row))
        .zip(canvas.last.chunks_mut(canvas_row))
        .map(|((((masks, colors), alphas), transmittance), last)| TileRow {
            colors,
            alphas,
            transmittance,
            last,
            depths: depths.next().unwrap_or_default(),
            masks,
        })
        .collect();
    rows.into_par_iter()
        .enumerate()
        .for_each(|(row, out)| composite_row(scene, row, out));
    canvas
}

fn composite_row<T: Real>(scene: &Scene<'_, T>, row: usize, out: TileRow<'_, T>) {
    let level = SimdLevel::detect();
    let grid = &scene.grid;
    let pixels = grid.pixels_per_tile();
    let total = scene.channels.total;
    let background: Vec<T> = (0..total).map(|channel| scene.background(channel)).collect();
    let mut planes = vec![T::ZERO; total * pixels];
    let first_entry = scene.bins.offsets[row * grid.columns] as usize;
    for column in 0..grid.columns {
        let tile = row * grid.columns + column;
        let mut task = scene.task(tile);
        let own = column * pixels..(column + 1) * pixels;
        let transmittance = &mut out.transmittance[own.clone()];
        if task.ranks.is_empty() {
            planes.fill(T::ZERO);
        } else {
            let mut open = [false; MAX_PIXELS];
            scene.for_pixels(tile, |p, _| open[p] = true);
            let entries = scene.bins.offsets[tile] as usize - first_entry;
            while task.first < total {
                let tile_image = TileImage {
                    colors: &mut planes[task.first * pixels..],
                    transmittance: &mut *transmittance,
                    last: &mut out.last[own.clone()],
                    masks: &mut out.masks[entries..][..task.ranks.len()],
                };
                dispatch::forward(level, &task, &open, tile_image);
                task.first += MAX_CHANNELS;
            }
        }
        if scene.expected_depth {
            out.depths[own].copy_from_slice(&planes[(total - 1) * pixels..]);
        }
        write_tile(
            scene,
            &background,
            column,
            &planes,
            transmittance,
            out.colors,
            out.alphas,
        );
    }
}

/// Writes a tile into its rows of the image: adds the background, divides expected depth by alpha.
fn write_tile<T: Real>(
    scene: &Scene<'_, T>,
    background: &[T],
    column: usize,
    planes: &[T],
    transmittance: &[T],
    colors: &mut [T],
    alphas: &mut [T],
) {
    let grid = &scene.grid;
    let total = scene.channels.total;
    let (pixels, side) = (grid.pixels_per_tile(), grid.tile_size / BLOCK);
    let left = column * grid.tile_size;
    for y in 0..alphas.len() / grid.width {
        for x in (0..grid.tile_size.min(grid.width - left)).step_by(BLOCK) {
            let p = (y / BLOCK * side + x / BLOCK) * LANES + y % BLOCK * BLOCK;
            for i in 0..BLOCK.min(grid.width - left - x) {
                let pixel = y * grid.width + left + x + i;
                let values = &mut colors[pixel * total..][..total];
                for (channel, value) in values.iter_mut().enumerate() {
                    *value = planes[channel * pixels + p + i] + transmittance[p + i] * background[channel];
                }
                let alpha = T::ONE - transmittance[p + i];
                alphas[pixel] = alpha;
                if scene.expected_depth {
                    values[total - 1] = values[total - 1] / alpha.greater(T::of(LEAST_ALPHA));
                }
            }
        }
    }
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

/// The vjp of [`composite`].
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
        pieces_by_tile(&mut slots, &scene.bins.offsets, 1, stride),
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
                let (v_values, v_transmittance, any) = load_cotangents(scene, canvas, tile, task.first, v);
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
                        masks: &canvas.masks
                            [scene.bins.offsets[tile] as usize..scene.bins.offsets[tile + 1] as usize],
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
                    v_alpha += -(value * (canvas.depths[tile * pixels + p] / alpha));
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

//! All tiles of a view, front to back: from splats to an image.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::composite::dispatch::{self, SPARE_CHANNELS};
use crate::composite::kernel::{BLOCK, Lanes, MAX_CHANNELS, MAX_SIDE, TileImage};
use crate::composite::scene::Scene;
use crate::math::real::Real;
use crate::memory::pool::{Buffers, Pooled, bytes_of, stale};
use crate::simd::Vectors;
use crate::simd::level::{Simd, Work};

/// Expected depth divides by alpha, or by this where there is hardly any; gsplat's constant.
pub(crate) const LEAST_ALPHA: f64 = 1e-10;

/// What the backward pass needs of the composited tiles. Tile-major, a block of pixels in each `Lanes`.
#[derive(Debug)]
pub(crate) struct Canvas<T> {
    /// Not set for a tile that nothing reaches, nor is what follows.
    pub(crate) transmittance: Vec<Lanes<T>>,
    /// See [`TileImage`].
    pub(crate) end: Vec<Lanes<T>>,
    /// Which blocks of its tile each intersection reaches; in the order of `TileLists::entries`.
    pub(crate) masks: Vec<u64>,
    /// Accumulated depth where the image has expected depth, else empty.
    pub(crate) depths: Vec<Lanes<T>>,
    /// Pixels that stopped before the end of their tile's list.
    pub(crate) saturated: usize,
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

/// A tile's colours, a plane of blocks for each channel.
#[derive(Debug)]
struct Planes<T>(Vec<Lanes<T>>);

impl<T> Default for Planes<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T: Real> Buffers for Planes<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.0)
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
    masks: &'a mut [u64],
}

/// Takes the first values off, or all there are: an array that nobody asked for is empty.
pub(crate) fn cut<'a, U>(slice: &mut &'a mut [U], at: usize) -> &'a mut [U] {
    let at = at.min(slice.len());
    let (head, tail) = std::mem::take(slice).split_at_mut(at);
    *slice = tail;
    head
}

impl<'a, T: Real> Strip<'a, T> {
    /// Takes the first `tiles` tiles off.
    fn take(&mut self, scene: &Scene<'_, T>, tiles: usize) -> Self {
        let (blocks, offsets) = (scene.blocks(), &scene.lists.offsets);
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

/// Composites every tile over the background into the image, which holds zeros where no Gaussian reaches.
pub(crate) fn composite<T: Vectors>(
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
        colors: std::array::from_fn(|_| [].as_mut_slice()),
        alphas: std::array::from_fn(|_| [].as_mut_slice()),
        transmittance: stale(&mut out.transmittance, blocks),
        end: stale(&mut out.end, blocks),
        depths: stale(&mut out.depths, if scene.expected_depth { blocks } else { 0 }),
        masks: stale(&mut out.masks, scene.lists.entries.len()),
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
    // For a row of a tile.
    let background: Vec<T> = (0..grid.tile_size * total)
        .map(|i| scene.background(i % total))
        .collect();
    let planes = || {
        let mut planes = Pooled::<Planes<T>>::take();
        stale(&mut planes.0, (total + SPARE_CHANNELS) * scene.blocks());
        planes
    };
    let saturated = AtomicUsize::new(0);
    // One by one: tiles take times that differ too much for larger shares to end together.
    strips
        .into_par_iter()
        .with_max_len(1)
        .flat_map(|strip| rayon::iter::split(strip, |strip| strip.halves(scene)))
        .for_each_init(planes, |planes, mut strip| {
            while strip.tiles > 0 {
                let tile = strip.take(scene, 1);
                saturated.fetch_add(
                    composite_tile(scene, &background, &mut planes.0, tile),
                    Ordering::Relaxed,
                );
            }
        });
    out.saturated = saturated.into_inner();
    canvas
}

/// Composites one tile; returns how many of its pixels are saturated.
fn composite_tile<T: Vectors>(
    scene: &Scene<'_, T>,
    background: &[T],
    planes: &mut [Lanes<T>],
    out: Strip<'_, T>,
) -> usize {
    let mut saturated = 0;
    let level = scene.limits.level;
    let blocks = scene.blocks();
    let total = scene.channels.total;
    let mut task = scene.task(out.tile);
    if task.entries.is_empty() {
        if scene.background.is_some() {
            for row in out.colors {
                row.copy_from_slice(&background[..row.len()]);
            }
        }
        return 0;
    }
    let open = scene.open_pixels(out.tile);
    while task.first < total {
        let tile_image = TileImage {
            colors: &mut planes[task.first * blocks..],
            transmittance: &mut *out.transmittance,
            end: &mut *out.end,
            masks: &mut *out.masks,
            // Every group of channels counts the same pixels.
            saturated: &mut saturated,
        };
        dispatch::forward(level, &task, &open, tile_image);
        task.first += MAX_CHANNELS;
    }
    if scene.expected_depth {
        out.depths
            .copy_from_slice(&planes[(total - 1) * blocks..total * blocks]);
    }
    level.run(WriteTile {
        scene,
        background,
        planes,
        out,
    });
    saturated
}

/// [`write_tile`], or [`write_colors`] where that will do.
struct WriteTile<'a, T> {
    scene: &'a Scene<'a, T>,
    background: &'a [T],
    planes: &'a [Lanes<T>],
    out: Strip<'a, T>,
}

impl<T: Real> Work for WriteTile<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self {
            scene,
            background,
            planes,
            mut out,
        } = self;
        match scene.channels.total {
            1 if !scene.expected_depth => write_colors::<T, 1>(scene, background, planes, &mut out),
            3 if !scene.expected_depth => write_colors::<T, 3>(scene, background, planes, &mut out),
            4 if !scene.expected_depth => write_colors::<T, 4>(scene, background, planes, &mut out),
            5 if !scene.expected_depth => write_colors::<T, 5>(scene, background, planes, &mut out),
            6 if !scene.expected_depth => write_colors::<T, 6>(scene, background, planes, &mut out),
            _ => write_tile(scene, background, planes, &mut out),
        }
    }
}

/// Writes a tile into its rows of the image: adds the background, divides expected depth by alpha.
#[inline(always)]
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

/// Colours and alphas of a row of a block, over the background.
#[inline(always)]
fn row_of_block<T: Real, const K: usize>(
    block: usize,
    row: usize,
    blocks: usize,
    background: &[T; K],
    planes: &[Lanes<T>],
    transmittance: &[Lanes<T>],
) -> ([[T; K]; BLOCK], [T; BLOCK]) {
    let transmittance = transmittance[block].rows()[row];
    let (mut colors, mut alphas) = ([[T::ZERO; K]; BLOCK], [T::ZERO; BLOCK]);
    for k in 0..K {
        let values = planes[k * blocks + block].rows()[row];
        for i in 0..BLOCK {
            colors[i][k] = values[i] + transmittance[i] * background[k];
        }
    }
    for i in 0..BLOCK {
        alphas[i] = T::ONE - transmittance[i];
    }
    (colors, alphas)
}

/// [`write_tile`] for the usual numbers of channels and no division, a row of a block at a time.
#[inline(always)]
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
        let (whole_colors, last_colors) = colors.as_chunks_mut::<BLOCK>();
        let (whole_alphas, last_alphas) = alphas.as_chunks_mut::<BLOCK>();
        let last = first + whole_alphas.len();
        for (block, (colors, alphas)) in (first..).zip(whole_colors.iter_mut().zip(whole_alphas)) {
            (*colors, *alphas) = row_of_block(block, row, blocks, &background, planes, out.transmittance);
        }
        if !last_alphas.is_empty() {
            let (colors, alphas) = row_of_block(last, row, blocks, &background, planes, out.transmittance);
            last_colors.copy_from_slice(&colors[..last_colors.len()]);
            last_alphas.copy_from_slice(&alphas[..last_alphas.len()]);
        }
    }
}

//! The vjp of `composite`: from the gradient of an image to one of each splat in each tile.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::composite::dispatch;
use crate::composite::forward::Canvas;
use crate::composite::incoming::{Cotangents, Incoming, Load, SumIncoming};
use crate::composite::intersection_gradients::{IntersectionGradients, gradient_size};
use crate::composite::kernel::{MAX_CHANNELS, MOMENTS, TileCotangents};
use crate::composite::scene::Scene;
use crate::math::real::Real;
use crate::memory::pool::Pooled;
use crate::memory::shared_slice::{OwnPieces, Scattered};
use crate::simd::Vectors;

/// What the compositor's vjp yields.
#[derive(Debug)]
pub(crate) struct CompositeGradients<T: Real> {
    pub(crate) intersections: Pooled<IntersectionGradients<T>>,
    pub(crate) background: Vec<T>,
    /// Tiles whose incoming gradient was zero.
    pub(crate) tiles_skipped: usize,
}

/// Shares of an image's tiles that each thread takes at least, if there are as many tiles.
const SHARES: usize = 32;

/// The vjp of [`crate::composite::forward::composite`].
pub(crate) fn composite_vjp<T: Vectors>(
    scene: &Scene<'_, T>,
    canvas: &Canvas<T>,
    v: Cotangents<'_, T>,
    absolute: bool,
) -> CompositeGradients<T> {
    let level = scene.limits.level;
    let blocks = scene.blocks();
    let total = scene.channels.total;
    let size = gradient_size(total, absolute);
    let mut intersections = Pooled::<IntersectionGradients<T>>::take();
    let values = Scattered::new(intersections.values(scene.lists.entries.len() * size));
    let mut backgrounds = vec![T::ZERO; scene.grid.len() * total];
    let tiles_skipped = AtomicUsize::new(0);
    // Few at a time: tiles take times that differ too much for larger shares to end together.
    let at_once = scene.grid.len() / (SHARES * rayon::current_num_threads());
    backgrounds
        .par_chunks_mut(total)
        .enumerate()
        .with_max_len(at_once.max(1))
        .for_each_init(Incoming::pooled, |incoming, (tile, v_background)| {
            let mut task = scene.task(tile);
            if task.entries.is_empty() {
                if scene.background.is_some() {
                    level.run(SumIncoming {
                        scene,
                        tile,
                        v,
                        sums: v_background,
                    });
                }
                return;
            }
            let own = tile * blocks..(tile + 1) * blocks;
            let listed = scene.lists.offsets[tile] as usize..scene.lists.offsets[tile + 1] as usize;
            let transmittance = &canvas.transmittance[own.clone()];
            let mut skipped = true;
            while task.first < total {
                // SAFETY: every intersection has a number of its own and belongs to one tile, and a tile to one thread.
                #[allow(unsafe_code)]
                let gradients = unsafe { values.pieces(size) };
                let any = level.run(Load {
                    incoming,
                    scene,
                    canvas,
                    tile,
                    first: task.first,
                    v,
                    v_background: &mut *v_background,
                });
                if !any {
                    clear(task.entries, gradients, task.first, total);
                } else {
                    skipped = false;
                    let cotangents = TileCotangents {
                        transmittance,
                        end: &canvas.end[own.clone()],
                        masks: &canvas.masks[listed.clone()],
                        v_values: &incoming.v_values,
                        v_transmittance: &incoming.v_transmittance,
                    };
                    dispatch::backward(level, &task, &cotangents, gradients, absolute);
                }
                task.first += MAX_CHANNELS;
            }
            if skipped {
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
        intersections,
        background,
        tiles_skipped: tiles_skipped.into_inner(),
    }
}

/// Zeroes what a kernel would have written for the channels of the group that starts with `first`.
fn clear<T: Real>(entries: &[[u32; 2]], mut gradients: OwnPieces<'_, T>, first: usize, total: usize) {
    let channels = MOMENTS + first..MOMENTS + total.min(first + MAX_CHANNELS);
    for &[_, number] in entries {
        let gradient = gradients.at(number);
        if first == 0 {
            gradient.fill(T::ZERO);
        } else {
            gradient[channels.clone()].fill(T::ZERO);
        }
    }
}

//! All tiles of a view: the Gaussian at which transmittance falls to one half.

use rayon::prelude::*;

use crate::composite::dispatch;
use crate::composite::forward::Canvas;
use crate::composite::kernel::{Lanes, MAX_BLOCKS};
use crate::composite::scene::Scene;
use crate::simd::Vectors;

/// The Gaussian at each pixel's median depth, by rows and columns: the last in front of which transmittance is above
/// one half. −1 where there is none.
pub(crate) fn medians<T: Vectors>(scene: &Scene<'_, T>, canvas: &Canvas<T>) -> Vec<i32> {
    let grid = &scene.grid;
    let (level, blocks) = (scene.limits.level, scene.blocks());
    let mut ids = vec![-1; grid.width * grid.height];
    let rows = grid.tile_size * grid.width;
    ids.par_chunks_mut(rows).enumerate().for_each(|(row, ids)| {
        let mut places = [Lanes::ZERO; MAX_BLOCKS];
        for tile in row * grid.columns..(row + 1) * grid.columns {
            let task = scene.task(tile);
            if task.entries.is_empty() {
                continue;
            }
            let list = scene.lists.offsets[tile] as usize..scene.lists.offsets[tile + 1] as usize;
            let end = &canvas.end[tile * blocks..(tile + 1) * blocks];
            dispatch::median(level, &task, &canvas.masks[list], end, &mut places);
            scene.for_block_rows(tile, |block, lane, pixel, count| {
                let own = &mut ids[pixel - row * rows..][..count];
                for (id, place) in own.iter_mut().zip(&places[block].0[lane..]) {
                    if let Some(place) = place.past_ordinal().checked_sub(1) {
                        *id = task.entries[place as usize][0] as i32;
                    }
                }
            });
        }
    });
    ids
}

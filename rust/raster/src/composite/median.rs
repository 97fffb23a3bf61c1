//! All tiles of a view: at which Gaussian half the light is gone.

use rayon::prelude::*;

use crate::composite::dispatch;
use crate::composite::forward::Canvas;
use crate::composite::kernel::{Lanes, MAX_BLOCKS};
use crate::composite::scene::Scene;
use crate::simd::Vectors;
use crate::simd::level::SimdLevel;

/// The Gaussian at which half of each pixel's light is gone, by rows and columns: the last of those that more than
/// half reaches. −1 where nothing is seen.
pub(crate) fn medians<T: Vectors>(scene: &Scene<'_, T>, canvas: &Canvas<T>) -> Vec<i32> {
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

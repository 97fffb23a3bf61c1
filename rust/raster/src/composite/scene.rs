//! What all tiles of a view share.

use crate::composite::kernel::{BLOCK, LANES, MAX_BLOCKS, TileTask, anchor};
use crate::input::channels::Channels;
use crate::input::settings::Limits;
use crate::lists::tile_lists::TileLists;
use crate::math::real::Real;
use crate::project::splat::Splat;
use crate::project::tiles::TileGrid;

/// What all tiles of a view share.
#[derive(Clone, Copy)]
pub(crate) struct Scene<'a, T> {
    pub(crate) grid: TileGrid,
    pub(crate) lists: &'a TileLists,
    pub(crate) splats: &'a [Splat<T>],
    /// Camera z by Gaussian.
    pub(crate) depths: &'a [T],
    pub(crate) channels: Channels<'a, T>,
    pub(crate) expected_depth: bool,
    pub(crate) background: Option<&'a [T]>,
    pub(crate) pixel_mask: Option<&'a [bool]>,
    pub(crate) limits: &'a Limits<T>,
}

impl<'a, T: Real> Scene<'a, T> {
    pub(crate) fn task(&self, tile: usize) -> TileTask<'a, T> {
        let origin = self.grid.origin(tile);
        TileTask {
            origin,
            anchor: anchor(origin),
            side: self.grid.tile_size / BLOCK,
            entries: &self.lists.entries
                [self.lists.offsets[tile] as usize..self.lists.offsets[tile + 1] as usize],
            splats: self.splats,
            depths: self.depths,
            channels: self.channels,
            first: 0,
            limits: self.limits,
        }
    }

    pub(crate) fn blocks(&self) -> usize {
        self.grid.pixels_per_tile() / LANES
    }

    /// Calls `f` with (block in the tile, first lane, index in the image, pixels) for each row of each of a tile's
    /// blocks, as far as it lies in the image.
    #[inline(always)]
    pub(crate) fn for_block_rows(&self, tile: usize, mut f: impl FnMut(usize, usize, usize, usize)) {
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
    pub(crate) fn open_pixels(&self, tile: usize) -> [u16; MAX_BLOCKS] {
        let ((left, top), size) = (self.grid.origin(tile), self.grid.tile_size);
        if self.pixel_mask.is_none() && left + size <= self.grid.width && top + size <= self.grid.height {
            return [0xFFFF; MAX_BLOCKS];
        }
        let mut open = [0u16; MAX_BLOCKS];
        self.for_block_rows(tile, |block, lane, pixel, count| {
            let Some(mask) = self.pixel_mask else {
                open[block] |= ((1u16 << count) - 1) << lane;
                return;
            };
            for (i, &wanted) in mask[pixel..pixel + count].iter().enumerate() {
                open[block] |= u16::from(wanted) << (lane + i);
            }
        });
        open
    }

    /// The background of a channel; depth has none.
    pub(crate) fn background(&self, channel: usize) -> T {
        match self.background {
            Some(values) if channel < self.channels.colored => values[channel],
            _ => T::ZERO,
        }
    }
}

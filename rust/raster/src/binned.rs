//! The splats of a view, and which tiles they reach.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::bins::{BinScratch, TileBins, bin_tiles};
use crate::chunk::{CHUNK, ChunkSplats};
use crate::dispatch::SimdLevel;
use crate::error::RasterError;
use crate::levels;
use crate::pool::{Buffers, bytes_of, stale};
use crate::project::{Lens, ScreenInfo, Splat};
use crate::real::Real;
use crate::settings::Limits;
use crate::tiles::{Cover, TileGrid};
use crate::view::View;

/// (Gaussian, tile) pairs that are listed while projecting. With more, the rest is first only counted: should they be
/// more than can be numbered, that is to be said before they fill the memory.
const PATIENCE: usize = 1 << 26;

/// A view's splats and which tiles they reach.
#[derive(Debug)]
pub(crate) struct Binned<T> {
    /// By Gaussian; anything for one that no pixel sees.
    pub(crate) splats: Vec<Splat<T>>,
    /// By chunk of Gaussians.
    covers: Vec<Cover>,
    pub(crate) bins: TileBins,
}

impl<T> Default for Binned<T> {
    fn default() -> Self {
        Self {
            splats: Vec::new(),
            covers: Vec::new(),
            bins: TileBins::default(),
        }
    }
}

impl<T: Real> Buffers for Binned<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.splats) + self.covers.iter().map(Cover::bytes).sum::<usize>() + self.bins.bytes()
    }
}

impl<T: Real> Buffers for BinScratch<T> {
    fn bytes(&self) -> usize {
        self.bytes()
    }
}

impl<T: Real> Binned<T> {
    pub(crate) fn chunks(&self) -> &[Cover] {
        &self.covers[..self.splats.len().div_ceil(CHUNK)]
    }

    /// Projects the Gaussians of a view and finds the tiles that each reaches.
    pub(crate) fn project(
        &mut self,
        view: &View<'_, T>,
        limits: &Limits<T>,
        grid: &TileGrid,
        wanted: Option<&[bool]>,
        screen: ScreenInfo<'_, T>,
    ) {
        let n = view.gaussians.len();
        let chunks = n.div_ceil(CHUNK);
        if self.covers.len() < chunks {
            self.covers.resize_with(chunks, Cover::default);
        }
        let (lens, level) = (Lens::new(&view.camera, limits), SimdLevel::detect());
        let ScreenInfo {
            means2d,
            depths,
            radii,
        } = screen;
        for patience in [PATIENCE, usize::MAX] {
            let pairs = AtomicUsize::new(0);
            (
                stale(&mut self.splats, n).par_chunks_mut(CHUNK),
                self.covers[..chunks].par_iter_mut(),
                means2d.par_chunks_mut(CHUNK),
                depths.par_chunks_mut(CHUNK),
                radii.par_chunks_mut(CHUNK),
            )
                .into_par_iter()
                .enumerate()
                .for_each(|(chunk, (splats, cover, means2d, depths, radii))| {
                    cover.counting = pairs.load(Ordering::Relaxed) > patience;
                    let screen = ScreenInfo {
                        means2d,
                        depths,
                        radii,
                    };
                    let out = ChunkSplats {
                        splats,
                        screen,
                        cover: &mut *cover,
                    };
                    levels::project(level, &view.gaussians, chunk * CHUNK, &lens, grid, wanted, out);
                    pairs.fetch_add(cover.count(), Ordering::Relaxed);
                });
            let pairs = pairs.into_inner();
            if pairs <= patience || u32::try_from(pairs).is_err() {
                break;
            }
        }
    }

    /// Sorts the projected splats by depth and lists those of every tile.
    pub(crate) fn bin(&mut self, grid: &TileGrid, scratch: &mut BinScratch<T>) -> Result<(), RasterError> {
        let chunks = self.splats.len().div_ceil(CHUNK);
        let covers = &mut self.covers[..chunks];
        bin_tiles(&self.splats, covers, grid.len(), scratch, &mut self.bins)
    }
}

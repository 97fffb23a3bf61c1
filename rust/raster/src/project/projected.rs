//! The splats of a view, and which tiles each reaches.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::input::camera::Camera;
use crate::input::gaussians::Gaussians;
use crate::input::settings::Limits;
use crate::math::real::Real;
use crate::memory::pool::{Buffers, bytes_of, stale};
use crate::project::dispatch;
use crate::project::packet::{CHUNK, ChunkSplats};
use crate::project::splat::{Lens, ScreenInfo, Splat};
use crate::project::tiles::{Cover, TileGrid};
use crate::simd::level::SimdLevel;

/// (Gaussian, tile) pairs that are listed while projecting. With more, the rest is first only counted: should they be
/// more than can be numbered, that is to be said before they fill the memory.
const PATIENCE: usize = 1 << 26;

/// A view's splats and which tiles each reaches.
#[derive(Debug)]
pub(crate) struct Projected<T> {
    /// By Gaussian; anything for one that no pixel sees.
    pub(crate) splats: Vec<Splat<T>>,
    /// By chunk of Gaussians.
    covers: Vec<Cover>,
}

impl<T> Default for Projected<T> {
    fn default() -> Self {
        Self {
            splats: Vec::new(),
            covers: Vec::new(),
        }
    }
}

impl<T: Real> Buffers for Projected<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.splats) + self.covers.iter().map(Cover::bytes).sum::<usize>()
    }
}

impl<T: Real> Projected<T> {
    pub(crate) fn covers(&self) -> &[Cover] {
        &self.covers[..self.splats.len().div_ceil(CHUNK)]
    }

    pub(crate) fn covers_mut(&mut self) -> &mut [Cover] {
        &mut self.covers[..self.splats.len().div_ceil(CHUNK)]
    }

    /// Projects the Gaussians of a view and finds the tiles that each reaches.
    pub(crate) fn project(
        &mut self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        limits: &Limits<T>,
        grid: &TileGrid,
        wanted: Option<&[bool]>,
        screen: ScreenInfo<'_, T>,
    ) {
        let n = gaussians.len();
        let chunks = n.div_ceil(CHUNK);
        if self.covers.len() < chunks {
            self.covers.resize_with(chunks, Cover::default);
        }
        let (lens, level) = (Lens::new(camera, limits), SimdLevel::detect());
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
                    dispatch::project(level, gaussians, chunk * CHUNK, &lens, grid, wanted, out);
                    pairs.fetch_add(cover.count(), Ordering::Relaxed);
                });
            let pairs = pairs.into_inner();
            if pairs <= patience || u32::try_from(pairs).is_err() {
                break;
            }
        }
    }
}

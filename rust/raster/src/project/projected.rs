//! The splats of a view, and which tiles each reaches.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::input::camera::Camera;
use crate::input::channels::Channels;
use crate::input::gaussians::Gaussians;
use crate::input::settings::Limits;
use crate::math::real::Real;
use crate::memory::pool::{Buffers, bytes_of, stale};
use crate::project::dispatch;
use crate::project::packet::{PACKET_SIZE, PacketScratch, PacketSplats};
use crate::project::splat::{Projection, ScreenInfo, Splat};
use crate::project::tiles::{Cover, TileGrid};

/// Intersections that are listed while projecting. Beyond this many they are first only counted, because a call that has
/// more than can be numbered must fail before their list fills the memory.
const LISTED_AT_ONCE: usize = 1 << 26;

/// A view's splats and which tiles each reaches.
#[derive(Debug)]
pub(crate) struct Projected<T> {
    /// By Gaussian; of no meaning for one that no pixel sees.
    pub(crate) splats: Vec<Splat<T>>,
    /// Camera z, likewise.
    pub(crate) depths: Vec<T>,
    /// By packet of Gaussians.
    covers: Vec<Cover>,
}

impl<T> Default for Projected<T> {
    fn default() -> Self {
        Self {
            splats: Vec::new(),
            depths: Vec::new(),
            covers: Vec::new(),
        }
    }
}

impl<T: Real> Buffers for Projected<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.splats) + bytes_of(&self.depths) + self.covers.iter().map(Cover::bytes).sum::<usize>()
    }
}

impl<T: Real> Projected<T> {
    pub(crate) fn covers(&self) -> &[Cover] {
        &self.covers[..self.splats.len().div_ceil(PACKET_SIZE)]
    }

    pub(crate) fn covers_mut(&mut self) -> &mut [Cover] {
        &mut self.covers[..self.splats.len().div_ceil(PACKET_SIZE)]
    }

    /// Projects the Gaussians of a view and finds the tiles that each reaches.
    pub(crate) fn project(
        &mut self,
        gaussians: &Gaussians<'_, T>,
        channels: Channels<'_, T>,
        camera: &Camera<T>,
        limits: &Limits<T>,
        grid: &TileGrid,
        wanted: Option<&[bool]>,
        screen: ScreenInfo<'_, T>,
    ) {
        let n = gaussians.len();
        let packets = n.div_ceil(PACKET_SIZE);
        if self.covers.len() < packets {
            self.covers.resize_with(packets, Cover::default);
        }
        let (projection, level) = (Projection::new(camera, limits), limits.level);
        let ScreenInfo {
            means2d,
            depths: camera_zs,
            radii,
        } = screen;
        for limit in [LISTED_AT_ONCE, usize::MAX] {
            let intersections = AtomicUsize::new(0);
            (
                stale(&mut self.splats, n).par_chunks_mut(PACKET_SIZE),
                stale(&mut self.depths, n).par_chunks_mut(PACKET_SIZE),
                self.covers[..packets].par_iter_mut(),
                means2d.par_chunks_mut(PACKET_SIZE),
                camera_zs.par_chunks_mut(PACKET_SIZE),
                radii.par_chunks_mut(PACKET_SIZE),
            )
                .into_par_iter()
                .enumerate()
                .for_each_init(
                    PacketScratch::new,
                    |scratch, (packet, (splats, depths, cover, means2d, camera_zs, radii))| {
                        cover.counting = intersections.load(Ordering::Relaxed) > limit;
                        let screen = ScreenInfo {
                            means2d,
                            depths: camera_zs,
                            radii,
                        };
                        let out = PacketSplats {
                            splats,
                            depths,
                            screen,
                            cover: &mut *cover,
                        };
                        dispatch::project(
                            level,
                            gaussians,
                            &channels,
                            packet * PACKET_SIZE,
                            &projection,
                            grid,
                            wanted,
                            scratch,
                            out,
                        );
                        intersections.fetch_add(cover.count(), Ordering::Relaxed);
                    },
                );
            let intersections = intersections.into_inner();
            if intersections <= limit || u32::try_from(intersections).is_err() {
                break;
            }
        }
    }
}

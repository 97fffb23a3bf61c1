//! Runs the loops of `packet` at a CPU feature level.
//!
//! The arithmetic is the same at every level, down to the bit: these loops fuse no multiplication with an addition.

use crate::input::channels::Channels;
use crate::input::gaussians::Gaussians;
use crate::math::real::Real;
use crate::project::packet::{PacketScratch, PacketSplats, project_packet};
use crate::project::splat::Projection;
use crate::project::tiles::TileGrid;
use crate::simd::level::{Simd, SimdLevel, Work};

struct Project<'a, T, const ANTIALIASED: bool> {
    gaussians: &'a Gaussians<'a, T>,
    channels: &'a Channels<'a, T>,
    first: usize,
    projection: &'a Projection<T>,
    grid: &'a TileGrid,
    wanted: Option<&'a [bool]>,
    scratch: &'a mut PacketScratch<T>,
    out: PacketSplats<'a, T>,
}

impl<T: Real, const ANTIALIASED: bool> Work for Project<'_, T, ANTIALIASED> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        project_packet::<T, ANTIALIASED>(
            self.gaussians,
            self.channels,
            self.first,
            self.projection,
            self.grid,
            self.wanted,
            self.scratch,
            self.out,
        );
    }
}

/// [`project_packet`] at this level.
pub(crate) fn project<T: Real>(
    level: SimdLevel,
    gaussians: &Gaussians<'_, T>,
    channels: &Channels<'_, T>,
    first: usize,
    projection: &Projection<T>,
    grid: &TileGrid,
    wanted: Option<&[bool]>,
    scratch: &mut PacketScratch<T>,
    out: PacketSplats<'_, T>,
) {
    if projection.antialiased() {
        level.run(Project::<T, true> {
            gaussians,
            channels,
            first,
            projection,
            grid,
            wanted,
            scratch,
            out,
        });
    } else {
        level.run(Project::<T, false> {
            gaussians,
            channels,
            first,
            projection,
            grid,
            wanted,
            scratch,
            out,
        });
    }
}

//! Runs the loops that turn gradients of splats in tiles into gradients of Gaussians at a CPU feature level.
//!
//! The arithmetic is the same at every level, down to the bit: these loops fuse no multiplication with an addition.

use crate::backproject::sum_tiles::{PacketIntersections, ScreenGradients, sum_packet};
use crate::input::gaussians::Gaussians;
use crate::math::real::Real;
use crate::project::packet::{PacketGradients, packet_vjp};
use crate::project::splat::Projection;
use crate::simd::level::{Simd, SimdLevel, Work};

struct SumPacket<'a, T> {
    from: &'a PacketIntersections<'a, T>,
    out: ScreenGradients<'a, T>,
    v: &'a mut PacketGradients<T>,
}

impl<T: Real> Work for SumPacket<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        sum_packet(self.from, self.out, self.v);
    }
}

struct Vjp<'a, T, const ANTIALIASED: bool, const CAMERA: bool> {
    gaussians: &'a Gaussians<'a, T>,
    first: usize,
    projection: &'a Projection<T>,
    v: &'a mut PacketGradients<T>,
}

impl<T: Real, const ANTIALIASED: bool, const CAMERA: bool> Work for Vjp<'_, T, ANTIALIASED, CAMERA> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        packet_vjp::<T, ANTIALIASED, CAMERA>(self.gaussians, self.first, self.projection, self.v);
    }
}

/// [`sum_packet`] at this level.
pub(crate) fn sum<T: Real>(
    level: SimdLevel,
    from: &PacketIntersections<'_, T>,
    out: ScreenGradients<'_, T>,
    v: &mut PacketGradients<T>,
) {
    level.run(SumPacket { from, out, v });
}

/// [`packet_vjp`] at this level; the camera's part only if asked for.
pub(crate) fn vjp<T: Real>(
    level: SimdLevel,
    gaussians: &Gaussians<'_, T>,
    first: usize,
    projection: &Projection<T>,
    camera: bool,
    v: &mut PacketGradients<T>,
) {
    match (projection.antialiased(), camera) {
        (false, false) => level.run(Vjp::<T, false, false> {
            gaussians,
            first,
            projection,
            v,
        }),
        (false, true) => level.run(Vjp::<T, false, true> {
            gaussians,
            first,
            projection,
            v,
        }),
        (true, false) => level.run(Vjp::<T, true, false> {
            gaussians,
            first,
            projection,
            v,
        }),
        (true, true) => level.run(Vjp::<T, true, true> {
            gaussians,
            first,
            projection,
            v,
        }),
    }
}

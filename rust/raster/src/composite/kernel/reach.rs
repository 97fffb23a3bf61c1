//! Which blocks of a tile a splat reaches.

use super::{BLOCK, LANES, Lanes, TileTask};
use crate::math::real::Real;
use crate::project::splat::{Splat, log_threshold};
use crate::project::tiles::padded_reach;
use crate::simd::vector::Vector;

/// First pixel centres of every block of a tile, from its anchor.
pub(super) struct BlockCentres<T> {
    x: Lanes<T>,
    y: Lanes<T>,
    log_threshold: T,
    /// The blocks that exist.
    mask: u16,
}

impl<T: Real> BlockCentres<T> {
    #[inline(always)]
    pub(super) fn new(task: &TileTask<'_, T>) -> Self {
        let ([x, y], side) = (task.first_centre(), task.side);
        let offset = |at: usize| T::of((at * BLOCK) as f64);
        Self {
            x: Lanes(std::array::from_fn(|b| x + offset(b % side))),
            y: Lanes(std::array::from_fn(|b| y + offset(b / side))),
            log_threshold: log_threshold(task.limits),
            mask: ((1u32 << (side * side)) - 1) as u16,
        }
    }

    /// The blocks whose pixel centres' bounding box meets the ellipse {u² + v² ≤ reach} around a centre: exact, all
    /// blocks at once.
    ///
    /// The least of the form over a box that does not hold the centre lies on one of the two edges that face it.
    #[inline(always)]
    pub(super) fn reached<V: Vector<Scalar = T>>(
        &self,
        level: V::Level,
        splat: &Splat<T>,
        [x, y]: [T; 2],
    ) -> u16 {
        let (w11, w12, w22) = (
            V::splat(level, splat.w11),
            V::splat(level, splat.w12()),
            V::splat(level, splat.w22),
        );
        let reach = V::splat(level, padded_reach(splat.log_opacity - self.log_threshold));
        // On a vertical line the form is least at dy = tilt · dx, on a horizontal one at dx = slope · dy.
        let (tilt, slope) = (V::splat(level, splat.tilt), V::splat(level, splat.slope));
        let (x, y) = (V::splat(level, x), V::splat(level, y));
        let (span, zero) = (
            V::splat(level, T::of(BLOCK as f64 - 1.0)),
            V::splat(level, T::ZERO),
        );
        let mut mask = 0;
        for first in (0..LANES).step_by(V::LANES) {
            let left = self.x.get::<V>(level, first).minus(x);
            let top = self.y.get::<V>(level, first).minus(y);
            let (right, bottom) = (left.plus(span), top.plus(span));
            let near_x = left.max(right.min(zero));
            let near_y = top.max(bottom.min(zero));
            let y_on_edge = tilt.times(near_x).min(bottom).max(top);
            let x_on_edge = slope.times(near_y).min(right).max(left);
            let u1 = w11.times_plus(near_x, w12.times(y_on_edge));
            let v1 = w22.times(y_on_edge);
            let u2 = w11.times_plus(x_on_edge, w12.times(near_y));
            let v2 = w22.times(near_y);
            let least = u1
                .times_plus(u1, v1.times(v1))
                .min(u2.times_plus(u2, v2.times(v2)));
            mask |= V::bits(reach.at_least(least)) << first;
        }
        mask as u16 & self.mask
    }
}

//! One tile, front to back, until the transmittance of every pixel is at most one half.

use super::{Entry, LANES, Lanes, MAX_BLOCKS, PixelCentres, TileTask};
use crate::math::real::Real;
use crate::simd::vector::{FINEST, Vector};

/// For every pixel the [`Real::ordinal`] of the last splat in front of which transmittance is above one half; 0 where there
/// is none. Takes what [`super::forward_tile`] left of the tile, and composites as it does
/// with the finest exponential.
#[inline(always)]
pub(crate) fn median_tile<V: Vector>(
    level: V::Level,
    task: &TileTask<'_, V::Scalar>,
    masks: &[u64],
    end: &[Lanes<V::Scalar>],
    out: &mut [Lanes<V::Scalar>; MAX_BLOCKS],
) {
    let blocks = task.side * task.side;
    let centres = PixelCentres::new(task);
    let log_threshold = V::splat(level, task.log_threshold());
    let max_alpha = V::splat(level, task.limits.max_alpha);
    let half = V::splat(level, V::Scalar::of(0.5));
    let mut transmittance = [Lanes::ONE; MAX_BLOCKS];
    *out = [Lanes::ZERO; MAX_BLOCKS];
    let mut above_half = u64::MAX >> (MAX_BLOCKS - blocks);
    for (index, mask) in masks.iter().enumerate() {
        let mut rest = mask & above_half;
        if rest == 0 {
            continue;
        }
        let entry = Entry::<V::Scalar, 1>::load(task, index);
        let place = V::splat(level, entry.place);
        while rest != 0 {
            let block = rest.trailing_zeros() as usize & (MAX_BLOCKS - 1);
            rest &= rest - 1;
            let mut below = true;
            for lane in (0..LANES).step_by(V::LANES) {
                let (x, y) = centres.of::<V>(level, block, lane);
                let (u, v) = entry.whitened(x, y);
                let log_alpha = entry.log_alpha(u, v);
                let hit = V::both(
                    end[block].get::<V>(level, lane).at_least(place),
                    log_alpha.at_least(log_threshold),
                );
                let before = transmittance[block].get::<V>(level, lane);
                let counts = V::both(hit, before.above(half));
                out[block].set(lane, place.select(counts, out[block].get(level, lane)));
                let alpha = log_alpha.exp2::<FINEST>().min(max_alpha);
                let after = alpha.keep(hit).times_from(before, before);
                transmittance[block].set(lane, after);
                below &= V::bits(after.above(half)) == 0;
            }
            above_half &= !(u64::from(below) << block);
        }
        if above_half == 0 {
            break;
        }
    }
}

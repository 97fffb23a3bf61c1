//! From the gradients of intersections to those of splats: sums in the order of the tiles.

use std::ops::Range;

use crate::composite::intersection_gradients::gradient_size;
use crate::composite::kernel::{ABSOLUTES, LANES, MOMENTS};
use crate::input::channels::Channels;
use crate::math::real::Real;
use crate::project::packet::{PacketGradients, is_sound};
use crate::project::splat::Splat;
use crate::project::tiles::Cover;

/// The gradients of the intersections of a packet of Gaussians.
pub(crate) struct PacketIntersections<'a, T> {
    /// Of all packets.
    pub(crate) values: &'a [T],
    pub(crate) channels: Channels<'a, T>,
    pub(crate) absolute: bool,
    pub(crate) cover: &'a Cover,
    pub(crate) splats: &'a [Splat<T>],
}

/// Where the gradients of a packet go that do not pass through the camera; an empty slice is one that nobody asked for.
pub(crate) struct ScreenGradients<'a, T> {
    pub(crate) colors: &'a mut [T],
    pub(crate) means2d: &'a mut [[T; 2]],
    pub(crate) absgrad: &'a mut [[T; 2]],
    /// Leave what passes through `means2d` out of the moments.
    pub(crate) detach_means2d: bool,
}

/// The sums over one Gaussian's intersections.
struct Sums<T> {
    moments: [T; MOMENTS],
    /// Gradient of depth as a channel.
    depth: T,
    absolutes: [T; ABSOLUTES],
}

impl<T: Real> PacketIntersections<'_, T> {
    /// Sums values `first..first + LANES` of the gradients with these numbers; values beyond a gradient's size are of no
    /// meaning.
    #[inline(always)]
    fn vector(&self, own: Range<usize>, size: usize, first: usize) -> [T; LANES] {
        let mut sum = [T::ZERO; LANES];
        for number in own {
            let values = &self.values[number * size + first..][..LANES];
            for k in 0..LANES {
                sum[k] += values[k];
            }
        }
        sum
    }

    /// Sums the gradients of one Gaussian's intersections; writes the gradients of its colours to `colors` (none if empty).
    #[inline(always)]
    fn sums(&self, own: Range<usize>, size: usize, colors: &mut [T]) -> Sums<T> {
        let Channels { total, colored, .. } = self.channels;
        let values = self.vector(own.clone(), size, 0);
        let mut sums = Sums {
            moments: std::array::from_fn(|k| values[k]),
            depth: T::ZERO,
            absolutes: [T::ZERO; ABSOLUTES],
        };
        if colored == 3 && size == MOMENTS + 3 {
            // The usual case.
            if let Some(colors) = colors.first_chunk_mut::<3>() {
                *colors = std::array::from_fn(|k| values[MOMENTS + k]);
            }
            return sums;
        }
        for first in (0..size).step_by(LANES) {
            let values = self.vector(own.clone(), size, first);
            for (place, &value) in (first..size).zip(&values) {
                let Some(channel) = place.checked_sub(MOMENTS) else {
                    continue;
                };
                if channel < colored {
                    if let Some(color) = colors.get_mut(channel) {
                        *color = value;
                    }
                } else if channel < total {
                    sums.depth = value;
                } else {
                    sums.absolutes[channel - total] = value;
                }
            }
        }
        sums
    }
}

/// A gradient, or zeros if it is out of the scalar's range though `from`, which it was made of, is not; as in
/// [`packet_vjp`](crate::project::packet::packet_vjp).
#[inline(always)]
fn kept<T: Real>(gradient: [T; 2], from: [T; 2]) -> [T; 2] {
    if !is_sound(gradient) & is_sound(from) {
        [T::ZERO; 2]
    } else {
        gradient
    }
}

/// Sums the gradients of each Gaussian's intersections, and packs the moments for
/// [`packet_vjp`](crate::project::packet::packet_vjp).
#[inline(always)]
pub(crate) fn sum_packet<T: Real>(
    from: &PacketIntersections<'_, T>,
    out: ScreenGradients<'_, T>,
    v: &mut PacketGradients<T>,
) {
    let size = gradient_size(from.channels.total, from.absolute);
    let Channels { stride, colored, .. } = from.channels;
    // alpha = opacity · 2^e, e = −(u² + v²).
    let gain = T::of(2.0 * std::f64::consts::LN_2);
    for local in 0..from.cover.len() {
        let own = from.cover.intersections_of(local);
        if own.is_empty() {
            continue;
        }
        let colors = if out.colors.is_empty() {
            &mut []
        } else {
            &mut out.colors[local * stride..][..colored]
        };
        let sums = from.sums(own, size, colors);
        let (splat, [h, mut hu, mut hv, huu, huv, hvv]) = (&from.splats[local], sums.moments);
        if let Some(v) = out.absgrad.get_mut(local) {
            let [x, y] = sums.absolutes;
            *v = kept([gain * splat.w11 * x, gain * y], [x, y]);
        }
        if let Some(v) = out.means2d.get_mut(local) {
            *v = kept(
                [gain * splat.w11 * hu, gain * (splat.w12() * hu + splat.w22 * hv)],
                [hu, hv],
            );
            if out.detach_means2d {
                (hu, hv) = (T::ZERO, T::ZERO);
            }
        }
        v.push(local, [h, hu, hv, huu, huv, hvv, sums.depth]);
    }
}

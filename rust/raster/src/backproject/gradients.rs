//! The vjp of projecting a view: from the gradients of intersections to those of Gaussians and camera.

use rayon::prelude::*;

use crate::backproject::dispatch;
use crate::backproject::sum_tiles::{PacketIntersections, ScreenGradients};
use crate::input::camera::Camera;
use crate::input::channels::Channels;
use crate::input::gaussians::Gaussians;
use crate::input::settings::Limits;
use crate::math::real::Real;
use crate::project::packet::{PACKET_SIZE, PacketGradients};
use crate::project::projected::Projected;
use crate::project::splat::Projection;

/// Where the gradients of a view go; an empty slice is one that nobody asked for.
pub(crate) struct ViewGradients<'a, T> {
    pub(crate) means: &'a mut [[T; 3]],
    pub(crate) quats: &'a mut [[T; 4]],
    pub(crate) scales: &'a mut [[T; 3]],
    pub(crate) opacities: &'a mut [T],
    pub(crate) colors: &'a mut [T],
    pub(crate) viewmat: &'a mut [T],
    pub(crate) background: &'a mut [T],
    pub(crate) means2d: &'a mut [[T; 2]],
    /// Leave what passes through `means2d` out of the others.
    pub(crate) detach_means2d: bool,
    /// Sums over pixels of the absolute values of the parts of `means2d`.
    pub(crate) absgrad: &'a mut [[T; 2]],
}

/// Consecutive pieces of `values`, or `count` empty ones if there are no values.
fn pieces<U>(values: &mut [U], size: usize, count: usize) -> Vec<&mut [U]> {
    if values.is_empty() {
        (0..count).map(|_| [].as_mut_slice()).collect()
    } else {
        values.chunks_mut(size).collect()
    }
}

/// Gradients of the Gaussians and of the camera, given those of the intersections.
pub(crate) fn project_view_vjp<T: Real>(
    gaussians: &Gaussians<'_, T>,
    camera: &Camera<T>,
    limits: &Limits<T>,
    projected: &Projected<T>,
    channels: Channels<'_, T>,
    intersections: &[T],
    out: ViewGradients<'_, T>,
) {
    let (stride, colored) = (channels.stride, channels.colored);
    let absolute = !out.absgrad.is_empty();
    let want_camera = !out.viewmat.is_empty();
    let geometry = want_camera
        || !(out.means.is_empty()
            && out.quats.is_empty()
            && out.scales.is_empty()
            && out.opacities.is_empty());
    if !geometry && out.means2d.is_empty() && !absolute && (out.colors.is_empty() || colored == 0) {
        return;
    }
    let (projection, level) = (Projection::new(camera, limits), limits.level);
    let covers = projected.covers();
    let count = covers.len();
    let v_viewmats: Vec<[[T; 4]; 3]> = (
        pieces(out.means, PACKET_SIZE, count),
        pieces(out.quats, PACKET_SIZE, count),
        pieces(out.scales, PACKET_SIZE, count),
        pieces(out.opacities, PACKET_SIZE, count),
        pieces(out.colors, PACKET_SIZE * stride.max(1), count),
        pieces(out.means2d, PACKET_SIZE, count),
        pieces(out.absgrad, PACKET_SIZE, count),
        covers,
    )
        .into_par_iter()
        .enumerate()
        .map_init(
            PacketGradients::new,
            |v, (packet, (means, quats, scales, opacities, colors, means2d, absgrad, cover))| {
                let first = packet * PACKET_SIZE;
                let from = PacketIntersections {
                    values: intersections,
                    channels,
                    absolute,
                    cover,
                    splats: &projected.splats[first..first + cover.len()],
                };
                let screen = ScreenGradients {
                    colors,
                    means2d,
                    absgrad,
                    detach_means2d: out.detach_means2d,
                };
                v.clear();
                dispatch::sum(level, &from, screen, v);
                if geometry && v.len > 0 {
                    dispatch::vjp(level, gaussians, first, &projection, want_camera, v);
                    v.add_to(means, quats, scales, opacities);
                }
                v.viewmat
            },
        )
        .collect();
    if want_camera {
        for v in &v_viewmats {
            for (sum, &v) in out.viewmat.iter_mut().zip(v.as_flattened()) {
                *sum += v;
            }
        }
    }
}

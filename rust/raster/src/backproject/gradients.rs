//! The vjp of projecting a view: from the compositor's slots to the gradients of Gaussians and camera.

use rayon::prelude::*;

use crate::backproject::dispatch;
use crate::backproject::sum_tiles::{ChunkSlots, ScreenGradients};
use crate::composite::kernel::Channels;
use crate::input::camera::Camera;
use crate::input::gaussians::Gaussians;
use crate::input::settings::Limits;
use crate::lists::tile_lists::TileLists;
use crate::math::real::Real;
use crate::project::packet::{CHUNK, ChunkGradients};
use crate::project::projected::Projected;
use crate::project::splat::Lens;
use crate::simd::level::SimdLevel;

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

/// Gradients of the Gaussians and of the camera, given what the compositor's vjp left in its slots.
pub(crate) fn project_view_vjp<T: Real>(
    gaussians: &Gaussians<'_, T>,
    camera: &Camera<T>,
    limits: &Limits<T>,
    projected: &Projected<T>,
    bins: &TileLists,
    channels: Channels<'_, T>,
    slots: &[T],
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
    let (lens, level) = (Lens::new(camera, limits), SimdLevel::detect());
    let covers = projected.covers();
    let count = covers.len();
    let v_viewmats: Vec<[[T; 4]; 3]> = (
        pieces(out.means, CHUNK, count),
        pieces(out.quats, CHUNK, count),
        pieces(out.scales, CHUNK, count),
        pieces(out.opacities, CHUNK, count),
        pieces(out.colors, CHUNK * stride.max(1), count),
        pieces(out.means2d, CHUNK, count),
        pieces(out.absgrad, CHUNK, count),
        covers,
    )
        .into_par_iter()
        .enumerate()
        .map(
            |(chunk, (means, quats, scales, opacities, colors, means2d, absgrad, cover))| {
                let first = chunk * CHUNK;
                let from = ChunkSlots {
                    values: slots,
                    channels,
                    absolute,
                    positions: &bins.positions,
                    cover,
                    splats: &projected.splats[first..first + cover.len()],
                };
                let screen = ScreenGradients {
                    colors,
                    means2d,
                    absgrad,
                    detach_means2d: out.detach_means2d,
                };
                let mut v = ChunkGradients::new();
                dispatch::gather(level, &from, screen, &mut v);
                if geometry && v.len > 0 {
                    dispatch::vjp(level, gaussians, first, &lens, want_camera, &mut v);
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

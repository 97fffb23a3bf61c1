//! The vjp of projecting a view: from the compositor's slots to the gradients of Gaussians and camera.

use rayon::prelude::*;

use crate::binned::Binned;
use crate::chunk::{CHUNK, ChunkGradients};
use crate::dispatch::SimdLevel;
use crate::gather::{ChunkSlots, ScreenGradients};
use crate::kernel::Channels;
use crate::levels;
use crate::project::Lens;
use crate::real::Real;
use crate::settings::Limits;
use crate::view::{View, ViewGradients};

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
    view: &View<'_, T>,
    limits: &Limits<T>,
    binned: &Binned<T>,
    channels: Channels<'_, T>,
    slots: &[T],
    out: ViewGradients<'_, T>,
) {
    let (stride, colored) = (channels.stride, channels.colored);
    let absolute = !out.absgrad.is_empty();
    let camera = !out.viewmat.is_empty();
    let geometry = camera
        || !(out.means.is_empty()
            && out.quats.is_empty()
            && out.scales.is_empty()
            && out.opacities.is_empty());
    if !geometry && out.means2d.is_empty() && !absolute && (out.colors.is_empty() || colored == 0) {
        return;
    }
    let (lens, level) = (Lens::new(&view.camera, limits), SimdLevel::detect());
    let covers = binned.chunks();
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
                    positions: &binned.bins.positions,
                    cover,
                    splats: &binned.splats[first..first + cover.len()],
                };
                let screen = ScreenGradients {
                    colors,
                    means2d,
                    absgrad,
                    detach_means2d: out.detach_means2d,
                };
                let mut v = ChunkGradients::new();
                levels::gather(level, &from, screen, &mut v);
                if geometry && v.len > 0 {
                    levels::vjp(level, &view.gaussians, first, &lens, camera, &mut v);
                    v.add_to(means, quats, scales, opacities);
                }
                v.viewmat
            },
        )
        .collect();
    if camera {
        for v in &v_viewmats {
            for (sum, &v) in out.viewmat.iter_mut().zip(v.as_flattened()) {
                *sum += v;
            }
        }
    }
}

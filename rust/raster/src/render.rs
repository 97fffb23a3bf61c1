//! One view from Gaussians to image and back: the stages in order.

use rayon::prelude::*;

use crate::camera::Camera;
use crate::composite::{Canvas, Cotangents, Scene, composite, composite_vjp};
use crate::error::RasterError;
use crate::gaussians::{Gaussians, check_finite, check_length};
use crate::kernel::{Channels, MOMENTS};
use crate::project::{Projected, ScreenInfo, Splat, SplatGradient, project, project_vjp};
use crate::real::Real;
use crate::settings::{Limits, RasterSettings, RenderMode};
use crate::tiles::{TileBins, TileGrid, bin_tiles, sort_by_depth};

/// Gaussians whose gradients one task gathers. Fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 512;

/// Everything one image is made of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View<'a, T> {
    pub(crate) gaussians: Gaussians<'a, T>,
    pub(crate) camera: Camera<T>,
    pub(crate) background: Option<&'a [T]>,
    pub(crate) pixel_mask: Option<&'a [bool]>,
}

/// Where an image goes.
pub(crate) struct Image<'a, T> {
    pub(crate) colors: &'a mut [T],
    pub(crate) alphas: &'a mut [T],
    pub(crate) screen: ScreenInfo<'a, T>,
}

/// What the forward pass of a view keeps for the backward pass.
#[derive(Debug)]
pub(crate) struct ViewState<T> {
    ids: Vec<u32>,
    splats: Vec<Splat<T>>,
    bins: TileBins,
    canvas: Canvas<T>,
}

impl<T> ViewState<T> {
    pub(crate) fn visible(&self) -> usize {
        self.ids.len()
    }

    pub(crate) fn intersections(&self) -> usize {
        self.bins.ranks.len()
    }

    pub(crate) fn empty_tiles(&self) -> usize {
        self.bins
            .offsets
            .windows(2)
            .filter(|pair| pair[0] == pair[1])
            .count()
    }
}

/// Where the gradients of a view go; an empty slice is one that nobody asked for.
pub(crate) struct ViewGradients<'a, T> {
    pub(crate) means: &'a mut [[T; 3]],
    pub(crate) quats: &'a mut [[T; 4]],
    pub(crate) scales: &'a mut [[T; 3]],
    pub(crate) opacities: &'a mut [T],
    pub(crate) colors: &'a mut [T],
    pub(crate) viewmat: &'a mut [T],
    pub(crate) background: &'a mut [T],
}

fn channels_of<'a, T>(gaussians: &Gaussians<'a, T>, mode: RenderMode) -> Channels<'a, T> {
    let colored = if mode.has_colors() { gaussians.channels } else { 0 };
    Channels {
        colors: gaussians.colors,
        stride: gaussians.channels,
        total: colored + usize::from(mode.has_depth()),
        colored,
    }
}

pub(crate) fn scene<'a, T: Real>(
    view: &View<'a, T>,
    mode: RenderMode,
    limits: &'a Limits<T>,
    splats: &'a [Splat<T>],
    ids: &'a [u32],
    bins: &'a TileBins,
) -> Scene<'a, T> {
    Scene {
        grid: TileGrid::new(view.camera.width, view.camera.height, limits.tile_size),
        bins,
        splats,
        ids,
        channels: channels_of(&view.gaussians, mode),
        expected_depth: mode.expects_depth(),
        background: view.background,
        pixel_mask: view.pixel_mask,
        limits,
    }
}

/// Which tiles hold a pixel to be rendered.
fn wanted_tiles(mask: &[bool], grid: &TileGrid) -> Vec<bool> {
    let mut wanted = vec![false; grid.len()];
    for (y, row) in mask.chunks_exact(grid.width).enumerate() {
        let first = y / grid.tile_size * grid.columns;
        for (column, pixels) in row.chunks(grid.tile_size).enumerate() {
            wanted[first + column] |= pixels.contains(&true);
        }
    }
    wanted
}

/// Renders one view.
pub(crate) fn render_view<T: Real>(
    view: &View<'_, T>,
    mode: RenderMode,
    limits: &Limits<T>,
    image: Image<'_, T>,
) -> Result<ViewState<T>, RasterError> {
    let grid = TileGrid::new(view.camera.width, view.camera.height, limits.tile_size);
    let mut projected = project(&view.gaussians, &view.camera, limits, image.screen);
    sort_by_depth(&mut projected);
    let Projected { ids, splats } = projected;
    let wanted = view.pixel_mask.map(|mask| wanted_tiles(mask, &grid));
    let bins = bin_tiles(&splats, &grid, wanted.as_deref())?;
    let scene = scene(view, mode, limits, &splats, &ids, &bins);
    let canvas = composite(&scene, image.colors, image.alphas);
    Ok(ViewState {
        ids,
        splats,
        bins,
        canvas,
    })
}

/// Consecutive pieces of `values`, or `count` empty ones if there are no values.
fn pieces<U>(values: &mut [U], size: usize, count: usize) -> Vec<&mut [U]> {
    if values.is_empty() {
        (0..count).map(|_| [].as_mut_slice()).collect()
    } else {
        values.chunks_mut(size).collect()
    }
}

/// The vjp of [`render_view`]; returns how many tiles had no incoming gradient. Gradients are added.
pub(crate) fn render_view_vjp<T: Real>(
    view: &View<'_, T>,
    mode: RenderMode,
    limits: &Limits<T>,
    state: &ViewState<T>,
    v: Cotangents<'_, T>,
    out: ViewGradients<'_, T>,
) -> usize {
    let scene = scene(view, mode, limits, &state.splats, &state.ids, &state.bins);
    let gradients = composite_vjp(&scene, &state.canvas, v);
    for (sum, &v) in out.background.iter_mut().zip(&gradients.background) {
        *sum += v;
    }

    let n = view.gaussians.len();
    let Channels {
        total,
        colored,
        stride,
        ..
    } = scene.channels;
    let slot_size = MOMENTS + total;
    let geometry = !(out.means.is_empty()
        && out.quats.is_empty()
        && out.scales.is_empty()
        && out.opacities.is_empty()
        && out.viewmat.is_empty());
    if !geometry && (out.colors.is_empty() || colored == 0) {
        return gradients.tiles_skipped;
    }
    let mut rank_of = vec![u32::MAX; n];
    for (&id, rank) in state.ids.iter().zip(0..) {
        rank_of[id as usize] = rank;
    }
    let count = n.div_ceil(CHUNK);
    let v_viewmats: Vec<[[T; 4]; 3]> = (
        pieces(out.means, CHUNK, count),
        pieces(out.quats, CHUNK, count),
        pieces(out.scales, CHUNK, count),
        pieces(out.opacities, CHUNK, count),
        pieces(out.colors, CHUNK * stride.max(1), count),
        rank_of.par_chunks(CHUNK),
    )
        .into_par_iter()
        .enumerate()
        .map(|(chunk, (means, quats, scales, opacities, colors, ranks))| {
            let mut v_viewmat = [[T::ZERO; 4]; 3];
            let mut slot = vec![T::ZERO; slot_size];
            for (local, &rank) in ranks.iter().enumerate() {
                if rank == u32::MAX {
                    continue;
                }
                slot.fill(T::ZERO);
                let own = state.bins.starts[rank as usize]..state.bins.starts[rank as usize + 1];
                for &position in &state.bins.positions[own.start as usize..own.end as usize] {
                    let part = &gradients.slots[position as usize * slot_size..][..slot_size];
                    for (sum, &v) in slot.iter_mut().zip(part) {
                        *sum += v;
                    }
                }
                if !colors.is_empty() {
                    for (sum, &v) in colors[local * stride..][..colored]
                        .iter_mut()
                        .zip(&slot[MOMENTS..])
                    {
                        *sum += v;
                    }
                }
                if !geometry {
                    continue;
                }
                let v_splat = SplatGradient {
                    h: slot[0],
                    first: [slot[1], slot[2]],
                    second: [slot[3], slot[4], slot[5]],
                    depth: if total > colored {
                        slot[MOMENTS + colored]
                    } else {
                        T::ZERO
                    },
                };
                let i = chunk * CHUNK + local;
                let Some(v) = project_vjp(&view.gaussians, &view.camera, limits, i, &v_splat) else {
                    continue;
                };
                add(means.get_mut(local).map(<[T; 3]>::as_mut_slice), &v.mean);
                add(quats.get_mut(local).map(<[T; 4]>::as_mut_slice), &v.quat);
                add(scales.get_mut(local).map(<[T; 3]>::as_mut_slice), &v.scale);
                add(opacities.get_mut(local..=local), &[v.opacity]);
                add(Some(v_viewmat.as_flattened_mut()), v.viewmat.as_flattened());
            }
            v_viewmat
        })
        .collect();
    if !out.viewmat.is_empty() {
        for v in &v_viewmats {
            add(Some(out.viewmat), v.as_flattened());
        }
    }
    gradients.tiles_skipped
}

#[inline(always)]
fn add<T: Real>(sums: Option<&mut [T]>, values: &[T]) {
    if let Some(sums) = sums {
        for (sum, &value) in sums.iter_mut().zip(values) {
            *sum += value;
        }
    }
}

/// A rendered image.
#[derive(Debug)]
pub struct Frame<T> {
    /// Rows, columns, channels: the colours, then depth if the mode has it.
    pub colors: Vec<T>,
    /// Rows, columns.
    pub alphas: Vec<T>,
    /// Centres on screen in pixels; zeros for a Gaussian that no pixel sees.
    pub means2d: Vec<[T; 2]>,
    /// Camera z; zero for a Gaussian that no pixel sees.
    pub depths: Vec<T>,
    /// Half the extent on screen in pixels, along x and y; zero for a Gaussian that no pixel sees.
    pub radii: Vec<[i32; 2]>,
    state: ViewState<T>,
}

/// Gradients of all inputs of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct GaussianGrads<T> {
    /// Of the centres.
    pub means: Vec<[T; 3]>,
    /// Of the raw quaternions.
    pub quats: Vec<[T; 4]>,
    /// Of the standard deviations.
    pub scales: Vec<[T; 3]>,
    /// Of the opacities.
    pub opacities: Vec<T>,
    /// Of the colours.
    pub colors: Vec<T>,
    /// Of the first three rows of the world-to-camera matrix.
    pub viewmat: [[T; 4]; 3],
    /// Of the background.
    pub background: Vec<T>,
}

/// Renders single views.
#[derive(Clone, Debug)]
pub struct Renderer<T> {
    limits: Limits<T>,
    mode: RenderMode,
}

impl<T: Real> Renderer<T> {
    /// A renderer with these rules.
    ///
    /// # Errors
    /// A setting outside its range.
    pub fn new(settings: &RasterSettings, mode: RenderMode) -> Result<Self, RasterError> {
        Ok(Self {
            limits: Limits::new(settings)?,
            mode,
        })
    }

    /// Renders Gaussians; `background` has one value per colour channel (black if absent).
    ///
    /// # Errors
    /// A background of the wrong length or with a value that is not finite.
    pub fn render(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
    ) -> Result<Frame<T>, RasterError> {
        if let Some(values) = background {
            check_length("backgrounds", gaussians.channels, values.len())?;
            check_finite("backgrounds", values)?;
        }
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background,
            pixel_mask: None,
        };
        let (n, pixels) = (gaussians.len(), camera.width * camera.height);
        let total = channels_of(gaussians, self.mode).total;
        let mut colors = vec![T::ZERO; pixels * total];
        let mut alphas = vec![T::ZERO; pixels];
        let (mut means2d, mut depths, mut radii) = (vec![[T::ZERO; 2]; n], vec![T::ZERO; n], vec![[0; 2]; n]);
        let image = Image {
            colors: &mut colors,
            alphas: &mut alphas,
            screen: ScreenInfo {
                means2d: &mut means2d,
                depths: &mut depths,
                radii: &mut radii,
            },
        };
        let state = render_view(&view, self.mode, &self.limits, image)?;
        Ok(Frame {
            colors,
            alphas,
            means2d,
            depths,
            radii,
            state,
        })
    }

    /// Gradients of a loss with respect to all inputs of [`Renderer::render`], given its gradients with respect to
    /// the frame's colours and alphas. Call it with the inputs that made the frame.
    ///
    /// # Errors
    /// Gradients whose length is not that of the frame's arrays.
    pub fn render_vjp(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
        frame: &Frame<T>,
        v_colors: &[T],
        v_alphas: &[T],
    ) -> Result<GaussianGrads<T>, RasterError> {
        check_length("v_colors", frame.colors.len(), v_colors.len())?;
        check_length("v_alphas", frame.alphas.len(), v_alphas.len())?;
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background,
            pixel_mask: None,
        };
        let n = gaussians.len();
        let mut grads = GaussianGrads {
            means: vec![[T::ZERO; 3]; n],
            quats: vec![[T::ZERO; 4]; n],
            scales: vec![[T::ZERO; 3]; n],
            opacities: vec![T::ZERO; n],
            colors: vec![T::ZERO; n * gaussians.channels],
            viewmat: [[T::ZERO; 4]; 3],
            background: vec![T::ZERO; gaussians.channels],
        };
        let out = ViewGradients {
            means: &mut grads.means,
            quats: &mut grads.quats,
            scales: &mut grads.scales,
            opacities: &mut grads.opacities,
            colors: &mut grads.colors,
            viewmat: grads.viewmat.as_flattened_mut(),
            background: &mut grads.background,
        };
        let v = Cotangents {
            colors: v_colors,
            alphas: v_alphas,
        };
        render_view_vjp(&view, self.mode, &self.limits, &frame.state, v, out);
        Ok(grads)
    }
}

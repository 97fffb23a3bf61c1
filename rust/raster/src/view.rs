//! One view from Gaussians to image and back: the stages in order.

use crate::binned::Binned;
use crate::camera::Camera;
use crate::composite::Canvas;
use crate::composite_vjp::Cotangents;
use crate::error::RasterError;
use crate::gaussians::Gaussians;
use crate::kernel::Channels;
use crate::pool::Pooled;
use crate::project::ScreenInfo;
use crate::real::Real;
use crate::scene::Scene;
use crate::settings::{Limits, RenderMode};
use crate::tiles::TileGrid;

/// Everything one image is made of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View<'a, T> {
    pub(crate) gaussians: Gaussians<'a, T>,
    pub(crate) camera: Camera<T>,
    pub(crate) background: Option<&'a [T]>,
    pub(crate) pixel_mask: Option<&'a [bool]>,
}

/// Where an image goes: arrays of zeros.
pub(crate) struct Image<'a, T> {
    pub(crate) colors: &'a mut [T],
    pub(crate) alphas: &'a mut [T],
    pub(crate) screen: ScreenInfo<'a, T>,
}

/// What the forward pass of a view keeps for the backward pass.
#[derive(Debug)]
pub(crate) struct ViewState<T: Real> {
    grid: TileGrid,
    limits: Limits<T>,
    binned: Pooled<Binned<T>>,
    canvas: Pooled<Canvas<T>>,
}

impl<T: Real> ViewState<T> {
    pub(crate) fn visible(&self) -> usize {
        self.binned.chunks().iter().map(|cover| cover.visible).sum()
    }

    /// See [`crate::Frame::median_ids`].
    pub(crate) fn median_ids(&self) -> Vec<i32> {
        let scene = Scene {
            grid: self.grid,
            bins: &self.binned.bins,
            splats: &self.binned.splats,
            // Only whom light reaches is asked, not with which colour.
            channels: Channels {
                colors: &[],
                stride: 0,
                total: 1,
                colored: 0,
            },
            expected_depth: false,
            background: None,
            pixel_mask: None,
            limits: &self.limits,
        };
        T::medians(&scene, &self.canvas)
    }

    pub(crate) fn culled(&self) -> usize {
        self.binned.splats.len() - self.visible()
    }

    pub(crate) fn intersections(&self) -> usize {
        self.binned.bins.ranks.len()
    }

    pub(crate) fn saturated(&self) -> usize {
        self.canvas.saturated
    }

    pub(crate) fn empty_tiles(&self) -> usize {
        self.binned
            .bins
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
    pub(crate) means2d: &'a mut [[T; 2]],
    /// Leave what passes through `means2d` out of the others.
    pub(crate) detach_means2d: bool,
    /// Sums over pixels of the absolute values of the parts of `means2d`.
    pub(crate) absgrad: &'a mut [[T; 2]],
}

pub(crate) fn channels_of<'a, T>(gaussians: &Gaussians<'a, T>, mode: RenderMode) -> Channels<'a, T> {
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
    binned: &'a Binned<T>,
) -> Scene<'a, T> {
    Scene {
        grid: TileGrid::new(view.camera.width, view.camera.height, limits.tile_size),
        bins: &binned.bins,
        splats: &binned.splats,
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
    let wanted = view.pixel_mask.map(|mask| wanted_tiles(mask, &grid));
    let mut binned = Pooled::<Binned<T>>::take();
    T::project(&mut binned, view, limits, &grid, wanted.as_deref(), image.screen);
    T::bin(&mut binned, &grid, &mut Pooled::take())?;
    let canvas = T::composite(&scene(view, mode, limits, &binned), image.colors, image.alphas);
    Ok(ViewState {
        grid,
        limits: *limits,
        binned,
        canvas,
    })
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
    let scene = scene(view, mode, limits, &state.binned);
    let gradients = T::composite_vjp(&scene, &state.canvas, v, !out.absgrad.is_empty());
    for (sum, &v) in out.background.iter_mut().zip(&gradients.background) {
        *sum += v;
    }
    T::project_vjp(
        view,
        limits,
        &state.binned,
        scene.channels,
        gradients.slots.written(),
        out,
    );
    gradients.tiles_skipped
}

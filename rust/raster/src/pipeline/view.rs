//! One view from Gaussians to image and back: the stages in order.

use crate::backproject::gradients::ViewGradients;
use crate::composite::forward::Canvas;
use crate::composite::incoming::Cotangents;
use crate::composite::scene::Scene;
use crate::error::RasterError;
use crate::input::camera::Camera;
use crate::input::channels::Channels;
use crate::input::gaussians::{Gaussians, check_length};
use crate::input::settings::{Limits, RenderMode};
use crate::lists::tile_lists::TileLists;
use crate::memory::pool::Pooled;
use crate::pipeline::scalar::Scalar;
use crate::project::projected::Projected;
use crate::project::splat::ScreenInfo;
use crate::project::tiles::TileGrid;

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
pub(crate) struct ViewState<T: Scalar> {
    camera: Camera<T>,
    mode: RenderMode,
    limits: Limits<T>,
    grid: TileGrid,
    channels: usize,
    background: Option<Vec<T>>,
    pixel_mask: Option<Vec<bool>>,
    projected: Pooled<Projected<T>>,
    lists: Pooled<TileLists>,
    canvas: Pooled<Canvas<T>>,
}

impl<T: Scalar> ViewState<T> {
    pub(crate) fn camera(&self) -> &Camera<T> {
        &self.camera
    }

    pub(crate) fn visible(&self) -> usize {
        self.projected.covers().iter().map(|cover| cover.visible).sum()
    }

    /// See [`crate::Frame::median_ids`].
    pub(crate) fn median_ids(&self) -> Vec<i32> {
        let scene = Scene {
            grid: self.grid,
            lists: &self.lists,
            splats: &self.projected.splats,
            depths: &self.projected.depths,
            // The median depends on how light passes, not on colours.
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
        self.projected.splats.len() - self.visible()
    }

    pub(crate) fn intersections(&self) -> usize {
        self.lists.entries.len()
    }

    pub(crate) fn saturated(&self) -> usize {
        self.canvas.saturated
    }

    pub(crate) fn empty_tiles(&self) -> usize {
        self.lists
            .offsets
            .windows(2)
            .filter(|pair| pair[0] == pair[1])
            .count()
    }
}

/// Where the channels of an image come from.
pub(crate) fn channels_of<'a, T>(gaussians: &Gaussians<'a, T>, mode: RenderMode) -> Channels<'a, T> {
    let colored = if mode.has_colors() { gaussians.channels } else { 0 };
    Channels {
        colors: gaussians.colors,
        stride: gaussians.channels,
        total: colored + usize::from(mode.has_depth()),
        colored,
    }
}

/// What all tiles share of a view whose splats are projected and listed.
pub(crate) fn scene<'a, T: Scalar>(
    view: &View<'a, T>,
    mode: RenderMode,
    limits: &'a Limits<T>,
    projected: &'a Projected<T>,
    lists: &'a TileLists,
) -> Scene<'a, T> {
    Scene {
        grid: TileGrid::new(view.camera.width, view.camera.height, limits.tile_size),
        lists,
        splats: &projected.splats,
        depths: &projected.depths,
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
pub(crate) fn render_view<T: Scalar>(
    view: &View<'_, T>,
    mode: RenderMode,
    limits: &Limits<T>,
    image: Image<'_, T>,
) -> Result<ViewState<T>, RasterError> {
    let grid = TileGrid::new(view.camera.width, view.camera.height, limits.tile_size);
    let wanted = view.pixel_mask.map(|mask| wanted_tiles(mask, &grid));
    let (mut projected, mut lists) = (Pooled::take(), Pooled::take());
    T::project(
        &mut projected,
        &view.gaussians,
        channels_of(&view.gaussians, mode),
        &view.camera,
        limits,
        &grid,
        wanted.as_deref(),
        image.screen,
    );
    T::bin(&mut projected, grid.len(), &mut Pooled::take(), &mut lists)?;
    let scene = scene(view, mode, limits, &projected, &lists);
    let canvas = T::composite(&scene, image.colors, image.alphas);
    Ok(ViewState {
        camera: view.camera,
        mode,
        limits: *limits,
        grid,
        channels: view.gaussians.channels,
        background: view.background.map(<[T]>::to_vec),
        pixel_mask: view.pixel_mask.map(<[bool]>::to_vec),
        projected,
        lists,
        canvas,
    })
}

impl<T: Scalar> ViewState<T> {
    /// The vjp of [`render_view`], given the Gaussians that it rendered; returns how many tiles had no incoming gradient.
    /// Gradients are added.
    ///
    /// # Errors
    /// Another number of Gaussians or channels, or gradients of another length than the image.
    pub(crate) fn vjp(
        &self,
        gaussians: &Gaussians<'_, T>,
        v: Cotangents<'_, T>,
        out: ViewGradients<'_, T>,
    ) -> Result<usize, RasterError> {
        check_length("means", self.projected.splats.len(), gaussians.len())?;
        if gaussians.channels != self.channels {
            return Err(RasterError::BadSize {
                name: "colors",
                expected: "as many channels as were rendered",
                got: gaussians.channels,
            });
        }
        let view = View {
            gaussians: *gaussians,
            camera: self.camera,
            background: self.background.as_deref(),
            pixel_mask: self.pixel_mask.as_deref(),
        };
        let scene = scene(&view, self.mode, &self.limits, &self.projected, &self.lists);
        let pixels = self.grid.width * self.grid.height;
        check_length("v_colors", pixels * scene.channels.total, v.colors.len())?;
        check_length("v_alphas", pixels, v.alphas.len())?;
        let gradients = T::composite_vjp(&scene, &self.canvas, v, !out.absgrad.is_empty());
        for (sum, &v) in out.background.iter_mut().zip(&gradients.background) {
            *sum += v;
        }
        T::project_vjp(
            gaussians,
            &self.camera,
            &self.limits,
            &self.projected,
            scene.channels,
            gradients.intersections.written(),
            out,
        );
        Ok(gradients.tiles_skipped)
    }
}

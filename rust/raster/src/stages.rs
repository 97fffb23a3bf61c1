//! The stages of a render one by one, for benchmarks.

use crate::camera::Camera;
use crate::composite::composite;
use crate::error::RasterError;
use crate::gaussians::Gaussians;
use crate::project::{Projected, ScreenInfo, project};
use crate::real::Real;
use crate::render::{View, scene};
use crate::settings::{Limits, RasterSettings, RenderMode};
use crate::tiles::{TileBins, TileGrid, bin_tiles, sort_by_depth};

/// A view taken through the forward stages, each of which can be repeated.
#[derive(Debug)]
pub struct Stages<'a, T> {
    view: View<'a, T>,
    mode: RenderMode,
    limits: Limits<T>,
    projected: Projected<T>,
    bins: TileBins,
}

impl<'a, T: Real> Stages<'a, T> {
    /// Runs every stage once.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn new(
        gaussians: &Gaussians<'a, T>,
        camera: &Camera<T>,
        settings: &RasterSettings,
        mode: RenderMode,
    ) -> Result<Self, RasterError> {
        let limits = Limits::new(settings)?;
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background: None,
            pixel_mask: None,
        };
        let projected = project_view(&view, &limits);
        let bins = bin_tiles(&projected.splats, &grid(&view, &limits), None)?;
        Ok(Self {
            view,
            mode,
            limits,
            projected,
            bins,
        })
    }

    /// Projects and sorts by depth.
    pub fn project(&mut self) {
        self.projected = project_view(&self.view, &self.limits);
    }

    /// Lists the splats of each tile.
    ///
    /// # Errors
    /// [`RasterError::TooManyIntersections`].
    pub fn bin(&mut self) -> Result<(), RasterError> {
        self.bins = bin_tiles(&self.projected.splats, &grid(&self.view, &self.limits), None)?;
        Ok(())
    }

    /// Composites all tiles into an image.
    pub fn composite(&self) -> Vec<T> {
        let Projected { ids, splats } = &self.projected;
        let scene = scene(&self.view, self.mode, &self.limits, splats, ids, &self.bins);
        let pixels = self.view.camera.width * self.view.camera.height;
        let mut colors = vec![T::ZERO; pixels * scene.channels.total];
        composite(&scene, &mut colors, &mut vec![T::ZERO; pixels]);
        colors
    }
}

fn grid<T: Real>(view: &View<'_, T>, limits: &Limits<T>) -> TileGrid {
    TileGrid::new(view.camera.width, view.camera.height, limits.tile_size)
}

fn project_view<T: Real>(view: &View<'_, T>, limits: &Limits<T>) -> Projected<T> {
    let n = view.gaussians.len();
    let info = ScreenInfo {
        means2d: &mut vec![[T::ZERO; 2]; n],
        depths: &mut vec![T::ZERO; n],
        radii: &mut vec![[0; 2]; n],
    };
    let mut projected = project(&view.gaussians, &view.camera, limits, info);
    sort_by_depth(&mut projected);
    projected
}

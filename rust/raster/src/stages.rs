//! The stages of a render one by one, for benchmarks.

use crate::camera::Camera;
use crate::composite::composite;
use crate::error::RasterError;
use crate::gaussians::Gaussians;
use crate::pool::Pooled;
use crate::project::ScreenInfo;
use crate::real::Real;
use crate::render::{Binned, View, scene};
use crate::settings::{Limits, RasterSettings, RenderMode};
use crate::tiles::{BinScratch, TileGrid};

/// A view taken through the forward stages, each of which can be repeated.
#[derive(Debug)]
pub struct Stages<'a, T: Real> {
    view: View<'a, T>,
    mode: RenderMode,
    limits: Limits<T>,
    grid: TileGrid,
    means2d: Vec<[T; 2]>,
    depths: Vec<T>,
    radii: Vec<[i32; 2]>,
    binned: Pooled<Binned<T>>,
    scratch: Pooled<BinScratch<T>>,
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
        let n = gaussians.len();
        let mut stages = Self {
            view: View {
                gaussians: *gaussians,
                camera: *camera,
                background: None,
                pixel_mask: None,
            },
            mode,
            limits,
            grid: TileGrid::new(camera.width, camera.height, limits.tile_size),
            means2d: vec![[T::ZERO; 2]; n],
            depths: vec![T::ZERO; n],
            radii: vec![[0; 2]; n],
            binned: Pooled::take(),
            scratch: Pooled::take(),
        };
        stages.project();
        stages.bin()?;
        Ok(stages)
    }

    /// Projects, and finds the tiles that each splat reaches.
    pub fn project(&mut self) {
        let screen = ScreenInfo {
            means2d: &mut self.means2d,
            depths: &mut self.depths,
            radii: &mut self.radii,
        };
        self.binned
            .project(&self.view, &self.limits, &self.grid, None, screen);
    }

    /// Sorts by depth and lists the splats of each tile.
    ///
    /// # Errors
    /// [`RasterError::TooManyIntersections`].
    pub fn bin(&mut self) -> Result<(), RasterError> {
        self.binned.bin(&self.grid, &mut self.scratch)
    }

    /// Composites all tiles into an image.
    pub fn composite(&self) -> Vec<T> {
        let scene = scene(&self.view, self.mode, &self.limits, &self.binned);
        let pixels = self.grid.width * self.grid.height;
        let mut colors = vec![T::ZERO; pixels * scene.channels.total];
        composite(&scene, &mut colors, &mut vec![T::ZERO; pixels]);
        colors
    }
}

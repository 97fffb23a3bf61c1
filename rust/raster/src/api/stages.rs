//! The stages of a render one by one, for benchmarks.

use rayon::prelude::*;

use crate::api::renderer::GaussianGrads;
use crate::composite::backward::CompositeGradients;
use crate::composite::forward::Canvas;
use crate::composite::incoming::Cotangents;
use crate::error::RasterError;
use crate::input::camera::Camera;
use crate::input::gaussians::{Gaussians, check_channels, check_length};
use crate::input::settings::{Limits, RasterSettings, RenderMode};
use crate::lists::tile_lists::{ListScratch, TileLists};
use crate::memory::pool::Pooled;
use crate::memory::results::filled_with;
use crate::pipeline::scalar::Scalar;
use crate::pipeline::view::{View, channels_of, scene};
use crate::project::projected::Projected;
use crate::project::splat::ScreenInfo;
use crate::project::tiles::TileGrid;

/// A view taken through the stages forward and back, each of which can be repeated.
#[derive(Debug)]
pub struct Stages<'a, T: Scalar> {
    view: View<'a, T>,
    mode: RenderMode,
    limits: Limits<T>,
    grid: TileGrid,
    means2d: Vec<[T; 2]>,
    depths: Vec<T>,
    radii: Vec<[i32; 2]>,
    projected: Pooled<Projected<T>>,
    lists: Pooled<TileLists>,
    scratch: Pooled<ListScratch<T>>,
    colors: Vec<T>,
    alphas: Vec<T>,
    canvas: Pooled<Canvas<T>>,
    gradients: CompositeGradients<T>,
}

impl<'a, T: Scalar> Stages<'a, T> {
    /// Runs every stage once, backward for a loss that is the sum of all colours.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn new(
        gaussians: &Gaussians<'a, T>,
        camera: &Camera<T>,
        settings: &RasterSettings,
        mode: RenderMode,
    ) -> Result<Self, RasterError> {
        check_channels(mode, gaussians.channels)?;
        if let Some(harmonics) = gaussians.harmonics {
            return Err(RasterError::BadSize {
                name: "harmonics",
                expected: "colours instead: stages have no camera to see harmonics from",
                got: harmonics.bases,
            });
        }
        let limits = Limits::new(settings)?;
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background: None,
            pixel_mask: None,
        };
        let grid = TileGrid::new(camera.width, camera.height, limits.tile_size);
        let n = gaussians.len();
        let mut means2d = filled_with("means2d", [T::ZERO; 2], &[n])?;
        let mut depths = filled_with("depths", T::ZERO, &[n])?;
        let mut radii = filled_with("radii", [0; 2], &[n])?;
        let (mut projected, mut lists, mut scratch) = (Pooled::take(), Pooled::take(), Pooled::take());
        let screen = ScreenInfo {
            means2d: &mut means2d,
            depths: &mut depths,
            radii: &mut radii,
        };
        T::project(
            &mut projected,
            &view.gaussians,
            channels_of(&view.gaussians, mode),
            &view.camera,
            &limits,
            &grid,
            None,
            screen,
        );
        T::bin(&mut projected, grid.len(), &mut scratch, &mut lists)?;
        let scene = scene(&view, mode, &limits, &projected, &lists);
        let pixels = grid.width * grid.height;
        let mut colors = filled_with("image", T::ZERO, &[pixels, scene.channels.total])?;
        let mut alphas = filled_with("image", T::ZERO, &[pixels])?;
        let canvas = T::composite(&scene, &mut colors, &mut alphas);
        let v = Cotangents {
            colors: &vec![T::ONE; colors.len()],
            alphas: &vec![T::ZERO; alphas.len()],
        };
        let gradients = T::composite_vjp(&scene, &canvas, v, false);
        Ok(Self {
            view,
            mode,
            limits,
            grid,
            means2d,
            depths,
            radii,
            projected,
            lists,
            scratch,
            colors,
            alphas,
            canvas,
            gradients,
        })
    }

    /// Projects, and finds the tiles that each splat reaches.
    pub fn project(&mut self) {
        let screen = ScreenInfo {
            means2d: &mut self.means2d,
            depths: &mut self.depths,
            radii: &mut self.radii,
        };
        T::project(
            &mut self.projected,
            &self.view.gaussians,
            channels_of(&self.view.gaussians, self.mode),
            &self.view.camera,
            &self.limits,
            &self.grid,
            None,
            screen,
        );
    }

    /// Sorts by depth and lists the splats of each tile.
    ///
    /// # Errors
    /// [`RasterError::TooManyIntersections`].
    pub fn bin(&mut self) -> Result<(), RasterError> {
        T::bin(
            &mut self.projected,
            self.grid.len(),
            &mut self.scratch,
            &mut self.lists,
        )
    }

    /// Composites all tiles into an image.
    pub fn composite(&mut self) -> &[T] {
        let scene = scene(&self.view, self.mode, &self.limits, &self.projected, &self.lists);
        self.canvas = T::composite(&scene, &mut self.colors, &mut self.alphas);
        &self.colors
    }

    /// The vjp of [`Stages::composite`], given the gradient of its image.
    ///
    /// # Errors
    /// A gradient of another length than the image.
    pub fn composite_vjp(&mut self, v_colors: &[T], v_alphas: &[T]) -> Result<(), RasterError> {
        check_length("v_colors", self.colors.len(), v_colors.len())?;
        check_length("v_alphas", self.alphas.len(), v_alphas.len())?;
        let scene = scene(&self.view, self.mode, &self.limits, &self.projected, &self.lists);
        let v = Cotangents {
            colors: v_colors,
            alphas: v_alphas,
        };
        self.gradients = T::composite_vjp(&scene, &self.canvas, v, false);
        Ok(())
    }

    /// The vjp of [`Stages::project`], given what the last [`Stages::composite_vjp`] left.
    ///
    /// # Errors
    /// [`RasterError::OutOfMemory`].
    pub fn project_vjp(&self) -> Result<GaussianGrads<T>, RasterError> {
        let mut grads = GaussianGrads::zeros(&self.view.gaussians, false)?;
        let channels = scene(&self.view, self.mode, &self.limits, &self.projected, &self.lists).channels;
        T::project_vjp(
            &self.view.gaussians,
            &self.view.camera,
            &self.limits,
            &self.projected,
            channels,
            self.gradients.intersections.written(),
            grads.slices(),
        );
        Ok(grads)
    }

    /// How many (pixel, Gaussian) pairs the image is made of: alpha reaches the threshold, and the pixel has not stopped.
    pub fn pairs(&self) -> usize {
        let limits = &self.limits;
        let (threshold, most, stop) = (
            limits.alpha_threshold.as_f64(),
            limits.max_alpha.as_f64(),
            limits.min_transmittance.as_f64(),
        );
        let (lists, size) = (&*self.lists, self.grid.tile_size);
        let in_pixel = |entries: &[[u32; 2]], column: usize, row: usize| {
            let (mut pairs, mut transmittance) = (0, 1.0);
            for &[gaussian, _] in entries {
                let splat = &self.projected.splats[gaussian as usize];
                let dx = column as f64 + 0.5 - splat.x.as_f64();
                let dy = row as f64 + 0.5 - splat.y.as_f64();
                let u = splat.w11.as_f64() * dx + splat.w12().as_f64() * dy;
                let v = splat.w22.as_f64() * dy;
                let alpha = (splat.log_opacity.as_f64() - (u * u + v * v)).exp2().min(most);
                if alpha < threshold {
                    continue;
                }
                transmittance *= 1.0 - alpha;
                if transmittance <= stop {
                    break;
                }
                pairs += 1;
            }
            pairs
        };
        (0..self.grid.len())
            .into_par_iter()
            .map(|tile| {
                let entries = &lists.entries[lists.offsets[tile] as usize..lists.offsets[tile + 1] as usize];
                let (left, top) = self.grid.origin(tile);
                let rows = top..(top + size).min(self.grid.height);
                rows.map(|row| {
                    let columns = left..(left + size).min(self.grid.width);
                    columns
                        .map(|column| in_pixel(entries, column, row))
                        .sum::<usize>()
                })
                .sum::<usize>()
            })
            .sum()
    }
}

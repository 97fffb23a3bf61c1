//! The stages of a render one by one, for benchmarks.

use rayon::prelude::*;

use crate::binned::Binned;
use crate::bins::BinScratch;
use crate::camera::Camera;
use crate::composite::Canvas;
use crate::composite_vjp::{CompositeGradients, Cotangents};
use crate::error::RasterError;
use crate::gaussians::{Gaussians, check_length};
use crate::pool::Pooled;
use crate::project::ScreenInfo;
use crate::real::Real;
use crate::renderer::GaussianGrads;
use crate::settings::{Limits, RasterSettings, RenderMode};
use crate::tiles::TileGrid;
use crate::view::{View, scene};

/// A view taken through the stages forward and back, each of which can be repeated.
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
    colors: Vec<T>,
    alphas: Vec<T>,
    canvas: Pooled<Canvas<T>>,
    gradients: CompositeGradients<T>,
}

impl<'a, T: Real> Stages<'a, T> {
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
        let limits = Limits::new(settings)?;
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background: None,
            pixel_mask: None,
        };
        let grid = TileGrid::new(camera.width, camera.height, limits.tile_size);
        let n = gaussians.len();
        let (mut means2d, mut depths, mut radii) = (vec![[T::ZERO; 2]; n], vec![T::ZERO; n], vec![[0; 2]; n]);
        let (mut binned, mut scratch) = (Pooled::take(), Pooled::take());
        let screen = ScreenInfo {
            means2d: &mut means2d,
            depths: &mut depths,
            radii: &mut radii,
        };
        T::project(&mut binned, &view, &limits, &grid, None, screen);
        T::bin(&mut binned, &grid, &mut scratch)?;
        let scene = scene(&view, mode, &limits, &binned);
        let pixels = grid.width * grid.height;
        let mut colors = vec![T::ZERO; pixels * scene.channels.total];
        let mut alphas = vec![T::ZERO; pixels];
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
            binned,
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
            &mut self.binned,
            &self.view,
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
        T::bin(&mut self.binned, &self.grid, &mut self.scratch)
    }

    /// Composites all tiles into an image.
    pub fn composite(&mut self) -> &[T] {
        let scene = scene(&self.view, self.mode, &self.limits, &self.binned);
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
        let scene = scene(&self.view, self.mode, &self.limits, &self.binned);
        let v = Cotangents {
            colors: v_colors,
            alphas: v_alphas,
        };
        self.gradients = T::composite_vjp(&scene, &self.canvas, v, false);
        Ok(())
    }

    /// The vjp of [`Stages::project`], given what the last [`Stages::composite_vjp`] left.
    pub fn project_vjp(&self) -> GaussianGrads<T> {
        let mut grads = GaussianGrads::zeros(&self.view.gaussians, false);
        let channels = scene(&self.view, self.mode, &self.limits, &self.binned).channels;
        T::project_vjp(
            &self.view,
            &self.limits,
            &self.binned,
            channels,
            self.gradients.slots.written(),
            grads.slices(),
        );
        grads
    }

    /// How many (pixel, Gaussian) pairs the image is made of: alpha reaches the threshold, and the pixel is not spent.
    pub fn pairs(&self) -> usize {
        let limits = &self.limits;
        let (threshold, most, stop) = (
            limits.alpha_threshold.as_f64(),
            limits.max_alpha.as_f64(),
            limits.min_transmittance.as_f64(),
        );
        let (bins, size) = (&self.binned.bins, self.grid.tile_size);
        let in_pixel = |ranks: &[u32], column: usize, row: usize| {
            let (mut pairs, mut transmittance) = (0, 1.0);
            for &rank in ranks {
                let splat = &self.binned.splats[rank as usize];
                let dx = column as f64 + 0.5 - splat.x.as_f64();
                let dy = row as f64 + 0.5 - splat.y.as_f64();
                let u = splat.w11.as_f64() * dx + splat.w12.as_f64() * dy;
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
                let ranks = &bins.ranks[bins.offsets[tile] as usize..bins.offsets[tile + 1] as usize];
                let (left, top) = self.grid.origin(tile);
                let rows = top..(top + size).min(self.grid.height);
                rows.map(|row| {
                    let columns = left..(left + size).min(self.grid.width);
                    columns.map(|column| in_pixel(ranks, column, row)).sum::<usize>()
                })
                .sum::<usize>()
            })
            .sum()
    }
}

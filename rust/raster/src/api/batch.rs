//! Many views at once, sharing what they share.

use rayon::prelude::*;

use crate::api::batch_inputs::{BatchInputs, BatchShape, Layout};
use crate::error::RasterError;
use crate::input::camera::{Camera, Intrinsics};
use crate::input::gaussians::check_finite;
use crate::input::settings::{Limits, RasterSettings, RenderMode};
use crate::memory::results::filled_with;
use crate::pipeline::scalar::Scalar;
use crate::pipeline::view::{Image, View, ViewState, render_view};
use crate::project::splat::ScreenInfo;

/// A checked batch.
#[derive(Debug)]
pub struct Batch<'a, T> {
    shape: BatchShape,
    inputs: BatchInputs<'a, T>,
    cameras: Vec<Camera<T>>,
    limits: Limits<T>,
    mode: RenderMode,
}

/// Images of a batch, one after the other, and what is known of each Gaussian in each view.
#[derive(Debug)]
#[non_exhaustive]
pub struct BatchImages<T> {
    /// Views, rows, columns, channels.
    pub colors: Vec<T>,
    /// Views, rows, columns.
    pub alphas: Vec<T>,
    /// Views, Gaussians, x and y in pixels.
    pub means2d: Vec<[T; 2]>,
    /// Views, Gaussians.
    pub depths: Vec<T>,
    /// Views, Gaussians, along x and y in pixels.
    pub radii: Vec<[i32; 2]>,
}

/// What the forward pass of a batch keeps for the backward pass.
///
/// It owns the cameras, mode, settings, backgrounds and mask of its batch; [`BatchState::vjp`] asks for the Gaussians only.
#[derive(Debug)]
pub struct BatchState<T: Scalar> {
    pub(crate) shape: BatchShape,
    pub(crate) mode: RenderMode,
    pub(crate) viewmats: Layout,
    pub(crate) backgrounds: Option<Layout>,
    pub(crate) views: Vec<ViewState<T>>,
}

/// Work done and skipped, summed over the views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Counters {
    /// (Gaussian, tile) intersections.
    pub intersections: usize,
    /// Gaussians that some pixel may see.
    pub visible: usize,
    /// Gaussians that no pixel can see: behind, off the image, too faint or too small.
    pub culled: usize,
    /// Tiles that nothing reaches or that `pixel_mask` closes.
    pub empty_tiles: usize,
    /// Pixels that stopped at `min_transmittance`: what lies behind is neither composited nor differentiated.
    pub saturated: usize,
}

impl<T: Scalar> BatchState<T> {
    /// For every pixel of every view, the Gaussian at its median depth; see [`crate::Frame::median_ids`].
    pub fn median_ids(&self) -> Vec<i32> {
        let views: Vec<Vec<i32>> = self.views.par_iter().map(ViewState::median_ids).collect();
        views.concat()
    }

    /// Sums over the views.
    pub fn counters(&self) -> Counters {
        self.views.iter().fold(Counters::default(), |sum, view| Counters {
            intersections: sum.intersections + view.intersections(),
            visible: sum.visible + view.visible(),
            culled: sum.culled + view.culled(),
            empty_tiles: sum.empty_tiles + view.empty_tiles(),
            saturated: sum.saturated + view.saturated(),
        })
    }
}

impl<'a, T: Scalar> Batch<'a, T> {
    /// Checks everything that rendering relies on.
    ///
    /// # Errors
    /// The first input that does not fit, is not finite or is no camera, or the first setting out of range.
    pub fn new(
        shape: BatchShape,
        inputs: BatchInputs<'a, T>,
        settings: &RasterSettings,
        mode: RenderMode,
    ) -> Result<Self, RasterError> {
        shape.check(mode)?;
        let limits = Limits::new(settings)?;
        inputs.gaussians.check_lengths(&shape)?;
        inputs.gaussians.check_values(&shape)?;
        let arrays = [("viewmats", inputs.viewmats, 16), ("Ks", inputs.ks, 9)];
        let backgrounds = inputs
            .backgrounds
            .map(|input| ("backgrounds", input, shape.channels));
        for (name, input, elements) in arrays.into_iter().chain(backgrounds) {
            input.check(name, &shape, elements)?;
            check_finite(name, input.data)?;
        }
        if let Some(mask) = inputs.pixel_mask {
            mask.check("pixel_mask", &shape, shape.pixels())?;
        }
        let cameras = (0..shape.views())
            .map(|view| {
                let viewmat = inputs.viewmats.part(view, shape.cameras);
                let k = inputs.ks.part(view, shape.cameras);
                if [k[1], k[3], k[6], k[7], k[8] - T::ONE] != [T::ZERO; 5] {
                    return Err(RasterError::BadCamera {
                        reason: "expected a camera matrix without skew and with 0 0 1 as its last row",
                    });
                }
                let intrinsics = Intrinsics {
                    fx: k[0],
                    fy: k[4],
                    cx: k[2],
                    cy: k[5],
                };
                let rows: &[[T; 4]] = viewmat.as_chunks().0;
                Camera::new(
                    [rows[0], rows[1], rows[2], rows[3]],
                    intrinsics,
                    shape.width,
                    shape.height,
                )
                .map(|camera| camera.with_model(inputs.camera_model))
            })
            .collect::<Result<_, _>>()?;
        Ok(Self {
            shape,
            inputs,
            cameras,
            limits,
            mode,
        })
    }

    fn view(&self, view: usize) -> View<'a, T> {
        let cameras = self.shape.cameras;
        View {
            gaussians: self.inputs.gaussians.of_view(view, &self.shape),
            camera: self.cameras[view],
            background: self.inputs.backgrounds.map(|input| input.part(view, cameras)),
            pixel_mask: self.inputs.pixel_mask.map(|input| input.part(view, cameras)),
        }
    }

    /// Renders every view.
    ///
    /// # Errors
    /// [`RasterError::TooManyIntersections`], [`RasterError::OutOfMemory`].
    pub fn render(&self) -> Result<(BatchImages<T>, BatchState<T>), RasterError> {
        let (views, n, pixels) = (self.shape.views(), self.shape.gaussians, self.shape.pixels());
        let total = self.shape.image_channels(self.mode);
        let mut images = BatchImages {
            colors: filled_with("images", T::ZERO, &[views, pixels, total])?,
            alphas: filled_with("images", T::ZERO, &[views, pixels])?,
            means2d: filled_with("means2d", [T::ZERO; 2], &[views, n])?,
            depths: filled_with("depths", T::ZERO, &[views, n])?,
            radii: filled_with("radii", [0; 2], &[views, n])?,
        };
        let states = (
            split(&mut images.colors, views),
            split(&mut images.alphas, views),
            split(&mut images.means2d, views),
            split(&mut images.depths, views),
            split(&mut images.radii, views),
        )
            .into_par_iter()
            .enumerate()
            .map(|(view, (colors, alphas, means2d, depths, radii))| {
                let image = Image {
                    colors,
                    alphas,
                    screen: ScreenInfo {
                        means2d,
                        depths,
                        radii,
                    },
                };
                render_view(&self.view(view), self.mode, &self.limits, image)
            })
            .collect::<Result<Vec<_>, _>>()?;
        let state = BatchState {
            shape: self.shape,
            mode: self.mode,
            viewmats: self.inputs.viewmats.layout(),
            backgrounds: self.inputs.backgrounds.map(|input| input.layout()),
            views: states,
        };
        Ok((images, state))
    }
}

/// Equal pieces of a buffer, one per view; empty ones of an empty buffer.
pub(crate) fn split<U>(buffer: &mut [U], views: usize) -> Vec<&mut [U]> {
    if buffer.is_empty() {
        return (0..views).map(|_| [].as_mut_slice()).collect();
    }
    let size = buffer.len() / views;
    buffer.chunks_exact_mut(size).collect()
}

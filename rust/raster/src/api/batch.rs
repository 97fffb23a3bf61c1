//! Many views at once, sharing what they share.

use rayon::prelude::*;

use crate::api::batch_inputs::{BatchInputs, BatchShape};
use crate::error::RasterError;
use crate::input::camera::{Camera, Intrinsics};
use crate::input::gaussians::{Gaussians, check_finite};
use crate::input::settings::{Limits, RasterSettings, RenderMode};
use crate::pipeline::scalar::Scalar;
use crate::pipeline::view::{Image, View, ViewState, render_view};
use crate::project::splat::ScreenInfo;

/// A checked batch.
#[derive(Debug)]
pub struct Batch<'a, T> {
    pub(crate) shape: BatchShape,
    pub(crate) inputs: BatchInputs<'a, T>,
    cameras: Vec<Camera<T>>,
    pub(crate) limits: Limits<T>,
    pub(crate) mode: RenderMode,
}

/// Images of a batch, one after the other, and what is known of each Gaussian in each view.
#[derive(Debug)]
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
#[derive(Debug)]
pub struct BatchState<T: Scalar> {
    pub(crate) views: Vec<ViewState<T>>,
}

/// Work done and skipped, summed over the views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
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

/// Whether the values of a batch's inputs are known to be finite.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Values {
    Checked,
    Unchecked,
}

fn rows<const N: usize, T>(slab: &[T]) -> &[[T; N]] {
    slab.as_chunks().0
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
        Self::checked(shape, inputs, settings, mode, Values::Unchecked)
    }

    /// The same for inputs whose values have passed [`Batch::new`] before, as those of a backward pass have.
    ///
    /// # Errors
    /// As [`Batch::new`], but values are not scanned.
    pub fn new_trusted(
        shape: BatchShape,
        inputs: BatchInputs<'a, T>,
        settings: &RasterSettings,
        mode: RenderMode,
    ) -> Result<Self, RasterError> {
        Self::checked(shape, inputs, settings, mode, Values::Checked)
    }

    fn checked(
        shape: BatchShape,
        inputs: BatchInputs<'a, T>,
        settings: &RasterSettings,
        mode: RenderMode,
        values: Values,
    ) -> Result<Self, RasterError> {
        let limits = Limits::new(settings)?;
        let n = shape.gaussians;
        let arrays = [
            ("means", inputs.means, 3 * n),
            ("quats", inputs.quats, 4 * n),
            ("scales", inputs.scales, 3 * n),
            ("opacities", inputs.opacities, n),
            ("colors", inputs.colors, shape.channels * n),
            ("viewmats", inputs.viewmats, 16),
            ("Ks", inputs.ks, 9),
        ];
        for (name, slabs, elements) in arrays.into_iter().chain(
            inputs
                .backgrounds
                .map(|slabs| ("backgrounds", slabs, shape.channels)),
        ) {
            slabs.check(name, &shape, elements)?;
            if values == Values::Unchecked {
                check_finite(name, slabs.data)?;
            }
        }
        if let Some(mask) = inputs.pixel_mask {
            mask.check("pixel_mask", &shape, shape.pixels())?;
        }
        let cameras = (0..shape.views())
            .map(|view| {
                let viewmat = inputs.viewmats.slab(view, shape.cameras);
                let k = inputs.ks.slab(view, shape.cameras);
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
                let rows = rows::<4, T>(viewmat);
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

    pub(crate) fn view(&self, view: usize) -> View<'a, T> {
        let cameras = self.shape.cameras;
        View {
            gaussians: Gaussians {
                means: rows(self.inputs.means.slab(view, cameras)),
                quats: rows(self.inputs.quats.slab(view, cameras)),
                scales: rows(self.inputs.scales.slab(view, cameras)),
                opacities: self.inputs.opacities.slab(view, cameras),
                colors: self.inputs.colors.slab(view, cameras),
                channels: self.shape.channels,
            },
            camera: self.cameras[view],
            background: self.inputs.backgrounds.map(|slabs| slabs.slab(view, cameras)),
            pixel_mask: self.inputs.pixel_mask.map(|slabs| slabs.slab(view, cameras)),
        }
    }

    /// Renders every view.
    ///
    /// # Errors
    /// [`RasterError::TooManyIntersections`].
    pub fn render(&self) -> Result<(BatchImages<T>, BatchState<T>), RasterError> {
        let (views, n, pixels) = (self.shape.views(), self.shape.gaussians, self.shape.pixels());
        let total = self.shape.image_channels(self.mode);
        let mut images = BatchImages {
            colors: vec![T::ZERO; views * pixels * total],
            alphas: vec![T::ZERO; views * pixels],
            means2d: vec![[T::ZERO; 2]; views * n],
            depths: vec![T::ZERO; views * n],
            radii: vec![[0; 2]; views * n],
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
        Ok((images, BatchState { views: states }))
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

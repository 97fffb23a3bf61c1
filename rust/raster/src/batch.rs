//! Many views at once, sharing what they share.

use rayon::prelude::*;

use crate::camera::{Camera, CameraModel, Intrinsics};
use crate::composite_vjp::Cotangents;
use crate::error::RasterError;
use crate::gaussians::{Gaussians, check_finite, check_length};
use crate::pool::{Buffers, Pooled, bytes_of};
use crate::project::ScreenInfo;
use crate::real::Real;
use crate::settings::{Limits, RasterSettings, RenderMode};
use crate::view::{Image, View, ViewGradients, ViewState, render_view, render_view_vjp};

/// An input of a batch: `entries` × `cameras` slabs, where 1 along either axis means "shared".
#[derive(Clone, Copy, Debug)]
pub struct Slabs<'a, U> {
    /// The slabs, one after the other.
    pub data: &'a [U],
    /// 1, or the number of batch entries.
    pub entries: usize,
    /// 1, or the number of cameras per entry.
    pub cameras: usize,
}

impl<'a, U> Slabs<'a, U> {
    fn count(&self) -> usize {
        self.entries * self.cameras
    }

    /// Which slab a view uses.
    fn index(&self, view: usize, cameras: usize) -> usize {
        let (entry, camera) = (view / cameras, view % cameras);
        (if self.entries > 1 { entry } else { 0 }) * self.cameras + if self.cameras > 1 { camera } else { 0 }
    }

    fn slab(&self, view: usize, cameras: usize) -> &'a [U] {
        let size = self.data.len() / self.count();
        &self.data[self.index(view, cameras) * size..][..size]
    }

    fn check(&self, name: &'static str, shape: &BatchShape, elements: usize) -> Result<(), RasterError> {
        let fits = |have: usize, want: usize| have == 1 || have == want;
        if !fits(self.entries, shape.entries) {
            return check_length(name, shape.entries, self.entries);
        }
        if !fits(self.cameras, shape.cameras) {
            return check_length(name, shape.cameras, self.cameras);
        }
        check_length(name, self.count() * elements, self.data.len())
    }
}

/// Sizes of a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BatchShape {
    /// Batch entries, for instance frames of a clip.
    pub entries: usize,
    /// Cameras per entry.
    pub cameras: usize,
    /// Gaussians per entry.
    pub gaussians: usize,
    /// Colour channels.
    pub channels: usize,
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
}

impl BatchShape {
    /// Images in the batch.
    pub fn views(&self) -> usize {
        self.entries * self.cameras
    }

    fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Channels of an image in this mode.
    pub fn image_channels(&self, mode: RenderMode) -> usize {
        (if mode.has_colors() { self.channels } else { 0 }) + usize::from(mode.has_depth())
    }
}

/// The inputs of a batch. Slabs of Gaussians have one row per Gaussian, `viewmats` 4×4 row-major matrices, `ks` 3×3.
#[derive(Clone, Copy, Debug)]
pub struct BatchInputs<'a, T> {
    /// Centres, 3 per Gaussian.
    pub means: Slabs<'a, T>,
    /// Rotations w x y z, 4 per Gaussian.
    pub quats: Slabs<'a, T>,
    /// Standard deviations, 3 per Gaussian.
    pub scales: Slabs<'a, T>,
    /// Opacities.
    pub opacities: Slabs<'a, T>,
    /// Colours, `channels` per Gaussian.
    pub colors: Slabs<'a, T>,
    /// World-to-camera matrices.
    pub viewmats: Slabs<'a, T>,
    /// Camera matrices.
    pub ks: Slabs<'a, T>,
    /// How every camera projects.
    pub camera_model: CameraModel,
    /// One value per channel.
    pub backgrounds: Option<Slabs<'a, T>>,
    /// One value per pixel; false is not rendered.
    pub pixel_mask: Option<Slabs<'a, bool>>,
}

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
pub struct BatchState<T: Real> {
    views: Vec<ViewState<T>>,
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

impl<T: Real> BatchState<T> {
    /// For every pixel of every view, the Gaussian at which half its light is gone; see
    /// [`crate::Frame::median_ids`].
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

/// Which gradients are asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub struct Wanted {
    pub means: bool,
    pub quats: bool,
    pub scales: bool,
    pub opacities: bool,
    pub colors: bool,
    pub viewmats: bool,
    pub backgrounds: bool,
    pub means2d: bool,
    /// Leave what passes through `means2d` out of the other gradients, for a caller that sends it on.
    pub detach_means2d: bool,
    pub absgrad: bool,
}

/// Gradients of a batch's inputs, each in the layout of its input; empty if not asked for. A shared input has the sum
/// over the views that share it, in order.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct BatchGradients<T> {
    pub means: Vec<T>,
    pub quats: Vec<T>,
    pub scales: Vec<T>,
    pub opacities: Vec<T>,
    pub colors: Vec<T>,
    /// Three rows of four per matrix: the last row of a world-to-camera matrix is constant.
    pub viewmats: Vec<T>,
    pub backgrounds: Vec<T>,
    /// Of the centres on screen: views, Gaussians, x and y per pixel.
    pub means2d: Vec<T>,
    /// Sums over pixels of the absolute values of what `means2d` sums, in its layout. With more than eight channels a
    /// pixel's part is that of eight at a time.
    pub absgrad: Vec<T>,
    /// Tiles of all views whose incoming gradient was zero.
    pub tiles_skipped: usize,
}

/// Nothing but zeros, for gradients that nobody gave.
#[derive(Debug, Default)]
struct Zeros<T>(Vec<T>);

impl<T: Real> Zeros<T> {
    fn of(&mut self, len: usize) -> &[T] {
        if self.0.len() < len {
            self.0.resize(len, T::ZERO);
        }
        &self.0[..len]
    }
}

impl<T: Real> Buffers for Zeros<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.0)
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

fn rows_mut<const N: usize, T>(slab: &mut [T]) -> &mut [[T; N]] {
    slab.as_chunks_mut().0
}

impl<'a, T: Real> Batch<'a, T> {
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

    fn view(&self, view: usize) -> View<'a, T> {
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

    /// Gradients of a loss, given its gradients with respect to the colours and alphas of [`Batch::render`]; `None`
    /// stands for zeros.
    ///
    /// # Errors
    /// Gradients whose length is not that of the images.
    pub fn render_vjp(
        &self,
        state: &BatchState<T>,
        v_colors: Option<&[T]>,
        v_alphas: Option<&[T]>,
        wanted: Wanted,
    ) -> Result<BatchGradients<T>, RasterError> {
        let (views, n, pixels) = (self.shape.views(), self.shape.gaussians, self.shape.pixels());
        let total = self.shape.image_channels(self.mode);
        let mut zeros = Pooled::<Zeros<T>>::take();
        let v_colors_size = views * pixels * total;
        let zeros = zeros.of(match (v_colors, v_alphas) {
            (None, _) => v_colors_size.max(views * pixels),
            (_, None) => views * pixels,
            _ => 0,
        });
        let v_colors = v_colors.unwrap_or_else(|| &zeros[..v_colors_size]);
        let v_alphas = v_alphas.unwrap_or_else(|| &zeros[..views * pixels]);
        check_length("v_colors", v_colors_size, v_colors.len())?;
        check_length("v_alphas", views * pixels, v_alphas.len())?;

        // One slab per view, summed where views share an input.
        let buffer = |wanted: bool, size: usize| vec![T::ZERO; if wanted { views * size } else { 0 }];
        let mut means = buffer(wanted.means, 3 * n);
        let mut quats = buffer(wanted.quats, 4 * n);
        let mut scales = buffer(wanted.scales, 3 * n);
        let mut opacities = buffer(wanted.opacities, n);
        let mut colors = buffer(wanted.colors, self.shape.channels * n);
        let mut viewmats = buffer(wanted.viewmats, 12);
        let mut backgrounds = buffer(wanted.backgrounds, self.shape.channels);
        let mut means2d = buffer(wanted.means2d, 2 * n);
        let mut absgrad = buffer(wanted.absgrad, 2 * n);
        let geometry = (
            split(&mut means, views),
            split(&mut quats, views),
            split(&mut scales, views),
            split(&mut opacities, views),
        );
        let rest = (
            split(&mut colors, views),
            split(&mut viewmats, views),
            split(&mut backgrounds, views),
            split(&mut means2d, views),
            split(&mut absgrad, views),
        );
        let tiles_skipped = (geometry.into_par_iter(), rest.into_par_iter())
            .into_par_iter()
            .enumerate()
            .map(
                |(
                    view,
                    ((means, quats, scales, opacities), (colors, viewmat, background, means2d, absgrad)),
                )| {
                    let v = Cotangents {
                        colors: &v_colors[view * pixels * total..][..pixels * total],
                        alphas: &v_alphas[view * pixels..][..pixels],
                    };
                    let out = ViewGradients {
                        means: rows_mut(means),
                        quats: rows_mut(quats),
                        scales: rows_mut(scales),
                        opacities,
                        colors,
                        viewmat,
                        background,
                        means2d: rows_mut(means2d),
                        detach_means2d: wanted.detach_means2d,
                        absgrad: rows_mut(absgrad),
                    };
                    let state = &state.views[view];
                    render_view_vjp(&self.view(view), self.mode, &self.limits, state, v, out)
                },
            )
            .sum();
        let inputs = &self.inputs;
        Ok(BatchGradients {
            means: self.shared(means, &inputs.means),
            quats: self.shared(quats, &inputs.quats),
            scales: self.shared(scales, &inputs.scales),
            opacities: self.shared(opacities, &inputs.opacities),
            colors: self.shared(colors, &inputs.colors),
            viewmats: self.shared(viewmats, &inputs.viewmats),
            backgrounds: match &inputs.backgrounds {
                Some(slabs) => self.shared(backgrounds, slabs),
                None => backgrounds,
            },
            means2d,
            absgrad,
            tiles_skipped,
        })
    }

    /// Sums gradients per view into gradients per slab, views in order.
    fn shared(&self, per_view: Vec<T>, slabs: &Slabs<'_, T>) -> Vec<T> {
        /// Elements summed by one task.
        const PART: usize = 4096;
        let views = self.shape.views();
        if slabs.count() == views || per_view.is_empty() {
            return per_view;
        }
        let size = per_view.len() / views;
        let mut sums = vec![T::ZERO; slabs.count() * size];
        for (index, slab) in sums.chunks_exact_mut(size).enumerate() {
            let sharing: Vec<&[T]> = per_view
                .chunks_exact(size)
                .enumerate()
                .filter(|&(view, _)| slabs.index(view, self.shape.cameras) == index)
                .map(|(_, values)| values)
                .collect();
            slab.par_chunks_mut(PART).enumerate().for_each(|(part, sums)| {
                for values in &sharing {
                    for (sum, &v) in sums.iter_mut().zip(&values[part * PART..]) {
                        *sum += v;
                    }
                }
            });
        }
        sums
    }
}

/// Equal pieces of a buffer, one per view; empty ones of an empty buffer.
fn split<U>(buffer: &mut [U], views: usize) -> Vec<&mut [U]> {
    if buffer.is_empty() {
        return (0..views).map(|_| [].as_mut_slice()).collect();
    }
    let size = buffer.len() / views;
    buffer.chunks_exact_mut(size).collect()
}

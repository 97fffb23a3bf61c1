//! Single views: what a caller renders, and differentiates.

use crate::backproject::gradients::ViewGradients;
use crate::composite::incoming::Cotangents;
use crate::error::RasterError;
use crate::input::camera::Camera;
use crate::input::gaussians::{Gaussians, check_channels, check_finite, check_length};
use crate::input::settings::{Limits, RasterSettings, RenderMode};
use crate::memory::results::{filled_with, product};
use crate::pipeline::scalar::Scalar;
use crate::pipeline::view::{Image, View, ViewState, render_view};
use crate::pipeline::view_colors::{view_colors, view_colors_vjp};
use crate::project::splat::ScreenInfo;

/// A rendered image, and what its gradients are computed from: camera, mode, settings, background and scratch memory.
#[derive(Debug)]
#[non_exhaustive]
pub struct Frame<T: Scalar> {
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
    absgrad: bool,
    /// The colours that the camera saw of harmonics.
    seen: Option<Vec<T>>,
    state: ViewState<T>,
}

impl<T: Scalar> Frame<T> {
    /// The Gaussian at each pixel's median depth, by rows and columns: the last in front of which transmittance is above
    /// one half, as in 2D Gaussian splatting. −1 where there is none. Its depth is the pixel's median depth, and
    /// has the gradient of that.
    #[must_use]
    pub fn median_ids(&self) -> Vec<i32> {
        self.state.median_ids()
    }

    /// Gradients of a loss with respect to all inputs of [`Renderer::render`], given its gradients with respect to the
    /// colours and alphas of this frame, and the Gaussians that it shows. Everything else the frame knows.
    ///
    /// A Gaussian of other values than were rendered has a gradient of no meaning.
    ///
    /// # Errors
    /// Another number of Gaussians or channels than were rendered, or gradients whose length is not that of the image.
    pub fn vjp(
        &self,
        gaussians: &Gaussians<'_, T>,
        v_colors: &[T],
        v_alphas: &[T],
    ) -> Result<GaussianGrads<T>, RasterError> {
        let v = Cotangents {
            colors: v_colors,
            alphas: v_alphas,
        };
        let Some((harmonics, colors)) = gaussians.harmonics.zip(self.seen.as_deref()) else {
            if gaussians.harmonics.is_some() || self.seen.is_some() {
                return Err(RasterError::BadSize {
                    name: "colors",
                    expected: "harmonics if they were rendered, and else colours",
                    got: gaussians.channels,
                });
            }
            let mut grads = GaussianGrads::zeros(gaussians, self.absgrad)?;
            self.state.vjp(gaussians, v, grads.slices())?;
            return Ok(grads);
        };
        check_length("colors", gaussians.len() * 3, colors.len())?;
        let painted = gaussians.with_colors(colors);
        let mut grads = GaussianGrads::zeros(&painted, self.absgrad)?;
        self.state.vjp(&painted, v, grads.slices())?;
        grads.colors = view_colors_vjp(
            gaussians.means,
            &harmonics,
            self.state.camera(),
            colors,
            &mut grads.colors,
            &mut grads.means,
            &mut grads.viewmat,
        )?;
        Ok(grads)
    }
}

/// Gradients of all inputs of a view.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct GaussianGrads<T> {
    /// Of the centres.
    pub means: Vec<[T; 3]>,
    /// Of the raw quaternions.
    pub quats: Vec<[T; 4]>,
    /// Of the standard deviations.
    pub scales: Vec<[T; 3]>,
    /// Of the opacities.
    pub opacities: Vec<T>,
    /// Of the colours, or of the coefficients of harmonics.
    pub colors: Vec<T>,
    /// Of the first three rows of the world-to-camera matrix.
    pub viewmat: [[T; 4]; 3],
    /// Of the background.
    pub background: Vec<T>,
    /// Of the centres on screen, per pixel: what densification strategies watch. Already contained in the others.
    pub means2d: Vec<[T; 2]>,
    /// Sums over pixels of the absolute values of what `means2d` sums; empty unless [`Renderer::with_absgrad`].
    pub absgrad: Vec<[T; 2]>,
}

impl<T: Scalar> GaussianGrads<T> {
    pub(crate) fn zeros(gaussians: &Gaussians<'_, T>, absgrad: bool) -> Result<Self, RasterError> {
        let n = gaussians.len();
        Ok(Self {
            means: filled_with("means", [T::ZERO; 3], &[n])?,
            quats: filled_with("quats", [T::ZERO; 4], &[n])?,
            scales: filled_with("scales", [T::ZERO; 3], &[n])?,
            opacities: filled_with("opacities", T::ZERO, &[n])?,
            colors: filled_with("colors", T::ZERO, &[gaussians.color_values()])?,
            viewmat: [[T::ZERO; 4]; 3],
            background: vec![T::ZERO; gaussians.channels],
            means2d: filled_with("means2d", [T::ZERO; 2], &[n])?,
            absgrad: filled_with("absgrad", [T::ZERO; 2], &[if absgrad { n } else { 0 }])?,
        })
    }

    /// Where a view's vjp adds them.
    pub(crate) fn slices(&mut self) -> ViewGradients<'_, T> {
        ViewGradients {
            means: &mut self.means,
            quats: &mut self.quats,
            scales: &mut self.scales,
            opacities: &mut self.opacities,
            colors: &mut self.colors,
            viewmat: self.viewmat.as_flattened_mut(),
            background: &mut self.background,
            means2d: &mut self.means2d,
            detach_means2d: false,
            absgrad: &mut self.absgrad,
        }
    }
}

/// Renders single views.
#[derive(Clone, Debug)]
pub struct Renderer<T> {
    limits: Limits<T>,
    mode: RenderMode,
    absgrad: bool,
}

impl<T: Scalar> Renderer<T> {
    /// A renderer with these rules.
    ///
    /// # Errors
    /// A setting outside its range.
    pub fn new(settings: &RasterSettings, mode: RenderMode) -> Result<Self, RasterError> {
        Ok(Self {
            limits: Limits::new(settings)?,
            mode,
            absgrad: false,
        })
    }

    /// The same renderer, whose gradients hold absolute ones on screen as well, which some densification strategies
    /// (AbsGS) read. With more than eight channels a pixel's part is that of eight at a time.
    #[must_use]
    pub fn with_absgrad(self) -> Self {
        Self {
            absgrad: true,
            ..self
        }
    }

    /// Renders Gaussians; `background` has one value per colour channel (black if absent).
    ///
    /// # Errors
    /// A mode with colours for Gaussians without, a background of the wrong length or with a value that is not finite,
    /// [`RasterError::TooManyIntersections`], [`RasterError::OutOfMemory`].
    pub fn render(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
    ) -> Result<Frame<T>, RasterError> {
        let pixels = camera.width * camera.height;
        let total = self.mode.channels(gaussians.channels);
        let mut colors = filled_with("image", T::ZERO, &[pixels, total])?;
        let mut alphas = filled_with("image", T::ZERO, &[pixels])?;
        let frame = self.render_over_zeros(gaussians, camera, background, &mut colors, &mut alphas)?;
        Ok(Frame {
            colors,
            alphas,
            ..frame
        })
    }

    /// [`Renderer::render`] into buffers of the caller's, of pixels × channels and of pixels, whatever they held. The
    /// frame's own `colors` and `alphas` stay empty.
    ///
    /// # Errors
    /// As [`Renderer::render`], and buffers of another length than the image.
    pub fn render_into(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
        colors: &mut [T],
        alphas: &mut [T],
    ) -> Result<Frame<T>, RasterError> {
        let pixels = camera.width * camera.height;
        let total = self.mode.channels(gaussians.channels);
        check_length("colors", product(&[pixels, total]), colors.len())?;
        check_length("alphas", pixels, alphas.len())?;
        colors.fill(T::ZERO);
        alphas.fill(T::ZERO);
        self.render_over_zeros(gaussians, camera, background, colors, alphas)
    }

    fn render_over_zeros(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
        colors: &mut [T],
        alphas: &mut [T],
    ) -> Result<Frame<T>, RasterError> {
        check_channels(self.mode, gaussians.channels)?;
        if let Some(values) = background {
            check_length("backgrounds", gaussians.channels, values.len())?;
            check_finite("backgrounds", values)?;
        }
        let seen = gaussians
            .harmonics
            .map(|harmonics| view_colors(gaussians.means, &harmonics, camera))
            .transpose()?;
        let view = View {
            gaussians: seen
                .as_ref()
                .map_or(*gaussians, |colors| gaussians.with_colors(colors)),
            camera: *camera,
            background,
            pixel_mask: None,
        };
        let n = gaussians.len();
        let mut means2d = filled_with("means2d", [T::ZERO; 2], &[n])?;
        let mut depths = filled_with("depths", T::ZERO, &[n])?;
        let mut radii = filled_with("radii", [0; 2], &[n])?;
        let image = Image {
            colors,
            alphas,
            screen: ScreenInfo {
                means2d: &mut means2d,
                depths: &mut depths,
                radii: &mut radii,
            },
        };
        let state = render_view(&view, self.mode, &self.limits, image)?;
        Ok(Frame {
            colors: Vec::new(),
            alphas: Vec::new(),
            means2d,
            depths,
            radii,
            absgrad: self.absgrad,
            seen,
            state,
        })
    }
}

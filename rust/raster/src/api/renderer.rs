//! Single views: what a caller renders, and differentiates.

use crate::backproject::gradients::ViewGradients;
use crate::composite::backward::Cotangents;
use crate::error::RasterError;
use crate::input::camera::Camera;
use crate::input::gaussians::{Gaussians, check_finite, check_length};
use crate::input::settings::{Limits, RasterSettings, RenderMode};
use crate::pipeline::scalar::Scalar;
use crate::pipeline::view::{Image, View, ViewState, channels_of, render_view, render_view_vjp};
use crate::project::splat::ScreenInfo;

/// A rendered image.
#[derive(Debug)]
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
}

/// Gradients of all inputs of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct GaussianGrads<T> {
    /// Of the centres.
    pub means: Vec<[T; 3]>,
    /// Of the raw quaternions.
    pub quats: Vec<[T; 4]>,
    /// Of the standard deviations.
    pub scales: Vec<[T; 3]>,
    /// Of the opacities.
    pub opacities: Vec<T>,
    /// Of the colours.
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
    pub(crate) fn zeros(gaussians: &Gaussians<'_, T>, absgrad: bool) -> Self {
        let n = gaussians.len();
        Self {
            means: vec![[T::ZERO; 3]; n],
            quats: vec![[T::ZERO; 4]; n],
            scales: vec![[T::ZERO; 3]; n],
            opacities: vec![T::ZERO; n],
            colors: vec![T::ZERO; n * gaussians.channels],
            viewmat: [[T::ZERO; 4]; 3],
            background: vec![T::ZERO; gaussians.channels],
            means2d: vec![[T::ZERO; 2]; n],
            absgrad: vec![[T::ZERO; 2]; if absgrad { n } else { 0 }],
        }
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
    /// A background of the wrong length or with a value that is not finite.
    pub fn render(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
    ) -> Result<Frame<T>, RasterError> {
        if let Some(values) = background {
            check_length("backgrounds", gaussians.channels, values.len())?;
            check_finite("backgrounds", values)?;
        }
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background,
            pixel_mask: None,
        };
        let (n, pixels) = (gaussians.len(), camera.width * camera.height);
        let total = channels_of(gaussians, self.mode).total;
        let mut colors = vec![T::ZERO; pixels * total];
        let mut alphas = vec![T::ZERO; pixels];
        let (mut means2d, mut depths, mut radii) = (vec![[T::ZERO; 2]; n], vec![T::ZERO; n], vec![[0; 2]; n]);
        let image = Image {
            colors: &mut colors,
            alphas: &mut alphas,
            screen: ScreenInfo {
                means2d: &mut means2d,
                depths: &mut depths,
                radii: &mut radii,
            },
        };
        let state = render_view(&view, self.mode, &self.limits, image)?;
        Ok(Frame {
            colors,
            alphas,
            means2d,
            depths,
            radii,
            state,
        })
    }

    /// Gradients of a loss with respect to all inputs of [`Renderer::render`], given its gradients with respect to
    /// the frame's colours and alphas. Call it with the inputs that made the frame.
    ///
    /// # Errors
    /// Gradients whose length is not that of the frame's arrays.
    pub fn render_vjp(
        &self,
        gaussians: &Gaussians<'_, T>,
        camera: &Camera<T>,
        background: Option<&[T]>,
        frame: &Frame<T>,
        v_colors: &[T],
        v_alphas: &[T],
    ) -> Result<GaussianGrads<T>, RasterError> {
        check_length("v_colors", frame.colors.len(), v_colors.len())?;
        check_length("v_alphas", frame.alphas.len(), v_alphas.len())?;
        let view = View {
            gaussians: *gaussians,
            camera: *camera,
            background,
            pixel_mask: None,
        };
        let mut grads = GaussianGrads::zeros(gaussians, self.absgrad);
        let v = Cotangents {
            colors: v_colors,
            alphas: v_alphas,
        };
        render_view_vjp(&view, self.mode, &self.limits, &frame.state, v, grads.slices());
        Ok(grads)
    }
}

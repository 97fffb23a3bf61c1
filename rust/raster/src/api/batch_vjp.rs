//! The vjp of a batch: gradients view by view, summed where views share an input.

use rayon::prelude::*;

use crate::api::batch::{BatchState, split};
use crate::api::batch_inputs::{BatchGaussians, Layout};
use crate::backproject::gradients::ViewGradients;
use crate::composite::incoming::Cotangents;
use crate::error::RasterError;
use crate::input::gaussians::check_length;
use crate::memory::pool::{Buffers, Pooled, bytes_of};
use crate::memory::results::filled_with;
use crate::pipeline::scalar::Scalar;

/// Which gradients are asked for; none by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
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
#[non_exhaustive]
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

impl<T: Scalar> Zeros<T> {
    fn of(&mut self, len: usize) -> &[T] {
        if self.0.len() < len {
            self.0.resize(len, T::ZERO);
        }
        &self.0[..len]
    }
}

impl<T: Scalar> Buffers for Zeros<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.0)
    }
}

fn rows_mut<const N: usize, T>(values: &mut [T]) -> &mut [[T; N]] {
    values.as_chunks_mut().0
}

impl<T: Scalar> BatchState<T> {
    /// Gradients of a loss, given its gradients with respect to the colours and alphas of the images, `None` standing for
    /// zeros, and the Gaussians that were rendered.
    ///
    /// # Errors
    /// Gaussians that do not fit the batch or are not finite, gradients whose length is not that of the images,
    /// [`RasterError::OutOfMemory`].
    pub fn vjp(
        &self,
        gaussians: &BatchGaussians<'_, T>,
        v_colors: Option<&[T]>,
        v_alphas: Option<&[T]>,
        wanted: Wanted,
    ) -> Result<BatchGradients<T>, RasterError> {
        gaussians.check_values(&self.shape)?;
        self.vjp_of_rendered(gaussians, v_colors, v_alphas, wanted)
    }

    /// [`BatchState::vjp`] for values that are known to be finite, as those are that were rendered and not changed since.
    ///
    /// # Errors
    /// As [`BatchState::vjp`], but values are not scanned: NaN gives NaN.
    pub fn vjp_of_rendered(
        &self,
        gaussians: &BatchGaussians<'_, T>,
        v_colors: Option<&[T]>,
        v_alphas: Option<&[T]>,
        wanted: Wanted,
    ) -> Result<BatchGradients<T>, RasterError> {
        gaussians.check_lengths(&self.shape)?;
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

        // One array per view, summed where views share an input.
        let buffer = |name: &'static str, wanted: bool, size: usize| {
            filled_with(name, T::ZERO, &[if wanted { views } else { 0 }, size])
        };
        let mut means = buffer("means", wanted.means, 3 * n)?;
        let mut quats = buffer("quats", wanted.quats, 4 * n)?;
        let mut scales = buffer("scales", wanted.scales, 3 * n)?;
        let mut opacities = buffer("opacities", wanted.opacities, n)?;
        let mut colors = buffer("colors", wanted.colors, self.shape.channels * n)?;
        let mut viewmats = buffer("viewmats", wanted.viewmats, 12)?;
        let mut backgrounds = buffer("backgrounds", wanted.backgrounds, self.shape.channels)?;
        let mut means2d = buffer("means2d", wanted.means2d, 2 * n)?;
        let mut absgrad = buffer("absgrad", wanted.absgrad, 2 * n)?;
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
                    self.views[view].vjp(&gaussians.of_view(view, &self.shape), v, out)
                },
            )
            .sum::<Result<usize, RasterError>>()?;
        // Values of a part of each input, none where nobody asked.
        let size = |wanted: bool, size: usize| if wanted { size } else { 0 };
        let channels = self.shape.channels;
        Ok(BatchGradients {
            means: self.shared(means, size(wanted.means, 3 * n), gaussians.means.layout())?,
            quats: self.shared(quats, size(wanted.quats, 4 * n), gaussians.quats.layout())?,
            scales: self.shared(scales, size(wanted.scales, 3 * n), gaussians.scales.layout())?,
            opacities: self.shared(opacities, size(wanted.opacities, n), gaussians.opacities.layout())?,
            colors: self.shared(
                colors,
                size(wanted.colors, channels * n),
                gaussians.colors.layout(),
            )?,
            viewmats: self.shared(viewmats, size(wanted.viewmats, 12), self.viewmats)?,
            backgrounds: match self.backgrounds {
                Some(layout) => self.shared(backgrounds, size(wanted.backgrounds, channels), layout)?,
                None => backgrounds,
            },
            means2d,
            absgrad,
            tiles_skipped,
        })
    }

    /// Sums gradients per view into gradients per part of `size` values, views in order; zeros where there is no view.
    fn shared(&self, per_view: Vec<T>, size: usize, layout: Layout) -> Result<Vec<T>, RasterError> {
        /// Elements summed by one task.
        const PART: usize = 4096;
        let views = self.shape.views();
        if layout.count() == views || size == 0 {
            return Ok(per_view);
        }
        let mut sums = filled_with("gradients", T::ZERO, &[layout.count(), size])?;
        for (index, part) in sums.chunks_exact_mut(size).enumerate() {
            let sharing: Vec<&[T]> = per_view
                .chunks_exact(size)
                .enumerate()
                .filter(|&(view, _)| layout.index(view, self.shape.cameras) == index)
                .map(|(_, values)| values)
                .collect();
            part.par_chunks_mut(PART).enumerate().for_each(|(part, sums)| {
                for values in &sharing {
                    for (sum, &v) in sums.iter_mut().zip(&values[part * PART..]) {
                        *sum += v;
                    }
                }
            });
        }
        Ok(sums)
    }
}

//! One subject rendered without the others.

use bigs_raster::{Real, filled_with};
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;
use crate::pixels::{Frames, RUN, add_run, area, sign};

/// Rendered pictures of one subject, and what the clip shows of it.
#[derive(Clone, Copy, Debug)]
pub struct Alone<'a, T> {
    /// What it covers.
    pub outline: Outline<'a, T>,
    /// Rendered colours, three a pixel; none where only the outline counts.
    pub colors: Option<&'a [T]>,
    /// The clip's colours; not read without rendered ones.
    pub images: &'a [T],
}

/// What one subject covers in some frames, and what the clip shows of it.
#[derive(Clone, Copy, Debug)]
pub struct Outline<'a, T> {
    /// Which frames.
    pub frames: Frames<'a>,
    /// Rendered coverage.
    pub alphas: &'a [T],
    /// The share of a pixel that shows the subject.
    pub own: &'a [T],
    /// The share in which something may hide it.
    pub hidden: &'a [T],
}

/// The terms, and the area that they are means over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Terms {
    /// |difference| and squared difference of colours over the subject's own pixels, and the squared distance of coverage
    /// from what its mask allows, between `own` and `own + hidden`, per pixel of the subject.
    pub values: [f64; 3],
    /// Pixels of the subject.
    pub own: f64,
}

impl<T: Real> Outline<'_, T> {
    fn check(&self) -> Result<(), OpsError> {
        self.frames.check()?;
        self.frames.check_rendered("alphas", self.alphas, 1)?;
        self.frames.check_clip("own", self.own, 1)?;
        self.frames.check_clip("hidden", self.hidden, 1)
    }

    /// The squared distance of each picture's coverage from what its mask allows, between `own` and `own + hidden`, B.
    ///
    /// # Errors
    /// A length that does not fit, or a frame that the clip does not have.
    pub fn squares(&self) -> Result<Vec<f64>, OpsError> {
        self.check()?;
        let pictures = (0..self.frames.frames.len()).into_par_iter();
        Ok(pictures.map(|index| self.sums(index)[0]).collect())
    }

    /// The gradient of the coverage from that of each picture's sum, B.
    ///
    /// # Errors
    /// As [`Outline::squares`].
    pub fn squares_vjp(&self, v: &[f64]) -> Result<Vec<T>, OpsError> {
        self.check()?;
        check_length("v", self.frames.frames.len(), v.len())?;
        self.pulls(|index| v[index])
    }

    /// The squared distance of a picture's coverage from what is allowed, and the subject's pixels.
    fn sums(&self, index: usize) -> [f64; 2] {
        let mut sums = [0.0; 2];
        let (alphas, own, hidden) = self.places(index);
        let places = alphas.chunks(RUN).zip(own.chunks(RUN)).zip(hidden.chunks(RUN));
        for ((alphas, own), hidden) in places {
            let mut run = [T::ZERO; 2];
            for ((&alpha, &own), &hidden) in alphas.iter().zip(own).zip(hidden) {
                let beyond = alpha - nearest(alpha, own, hidden);
                run[0] += beyond * beyond;
                run[1] += own;
            }
            add_run(&mut sums, run);
        }
        sums
    }

    /// The gradient of the coverage from those of the pictures' squared distances.
    fn pulls(&self, v: impl Fn(usize) -> f64 + Sync) -> Result<Vec<T>, OpsError> {
        let mut pulls = filled_with("v_alphas", T::ZERO, &[self.alphas.len()])?;
        pulls
            .par_chunks_exact_mut(self.frames.pixels.max(1))
            .enumerate()
            .for_each(|(index, pulls)| {
                let twice = T::of(v(index)) * T::of(2.0);
                let (alphas, own, hidden) = self.places(index);
                for (((pull, &alpha), &own), &hidden) in pulls.iter_mut().zip(alphas).zip(own).zip(hidden) {
                    *pull = twice * (alpha - nearest(alpha, own, hidden));
                }
            });
        Ok(pulls)
    }

    /// A picture's coverage, the subject's own pixels, and those in which something may hide it.
    fn places(&self, index: usize) -> (&[T], &[T], &[T]) {
        (
            self.frames.of_rendered(self.alphas, index, 1),
            self.frames.of_clip(self.own, index, 1),
            self.frames.of_clip(self.hidden, index, 1),
        )
    }
}

impl<T: Real> Alone<'_, T> {
    fn check(&self) -> Result<(), OpsError> {
        self.outline.check()?;
        if let Some(colors) = self.colors {
            self.outline.frames.check_rendered("colors", colors, 3)?;
            self.outline.frames.check_clip("images", self.images, 3)?;
        }
        Ok(())
    }

    /// The terms, checked.
    ///
    /// # Errors
    /// A length that does not fit, or a frame that the clip does not have.
    pub fn terms(&self) -> Result<Terms, OpsError> {
        self.check()?;
        let [absolute, squared, outside, own] = self.outline.frames.sums(|index| {
            let [outside, area] = self.outline.sums(index);
            let mut sums = [0.0; 2];
            let own = self.outline.places(index).1;
            let (colors, images) = self.pictures(index);
            for ((colors, images), own) in colors.chunks(RUN).zip(images.chunks(RUN)).zip(own.chunks(RUN)) {
                let mut run = [T::ZERO; 2];
                for ((color, image), &own) in colors.iter().zip(images).zip(own) {
                    if own > T::ZERO {
                        let (mut absolute, mut squared) = (T::ZERO, T::ZERO);
                        for c in 0..3 {
                            let difference = color[c] - image[c];
                            absolute += difference.abs();
                            squared += difference * difference;
                        }
                        run[0] += absolute * own;
                        run[1] += squared * own;
                    }
                }
                add_run(&mut sums, run);
            }
            [sums[0], sums[1], outside, area]
        });
        let colors = area(3.0 * own);
        Ok(Terms {
            values: [absolute / colors, squared / colors, outside / area(own)],
            own,
        })
    }

    /// Gradients of the rendered colours, empty where there are none, and of the coverage, from those of the terms.
    ///
    /// # Errors
    /// As [`Alone::terms`].
    pub fn vjp(&self, terms: &Terms, v: [f64; 3]) -> Result<(Vec<T>, Vec<T>), OpsError> {
        self.check()?;
        let two = T::of(2.0);
        let colors = area(3.0 * terms.own);
        let [absolute, squared] = [v[0] / colors, v[1] / colors].map(T::of);
        let v_alphas = self.outline.pulls(|_| v[2] / area(terms.own))?;
        let mut v_colors = filled_with("v_colors", T::ZERO, &[self.colors.map_or(0, <[T]>::len)])?;
        v_colors
            .par_chunks_exact_mut(3 * self.outline.frames.pixels.max(1))
            .enumerate()
            .for_each(|(index, v_colors)| {
                let (colors, images) = self.pictures(index);
                let own = self.outline.places(index).1;
                for (((v, color), image), &own) in v_colors
                    .as_chunks_mut()
                    .0
                    .iter_mut()
                    .zip(colors)
                    .zip(images)
                    .zip(own)
                {
                    if own > T::ZERO {
                        *v = [0, 1, 2].map(|c| {
                            let difference = color[c] - image[c];
                            own * (absolute * sign(difference) + squared * two * difference)
                        });
                    }
                }
            });
        Ok((v_colors, v_alphas))
    }

    fn pictures(&self, index: usize) -> (&[[T; 3]], &[[T; 3]]) {
        self.colors.map_or((&[], &[]), |colors| {
            (
                self.outline.frames.of_rendered(colors, index, 3).as_chunks().0,
                self.outline.frames.of_clip(self.images, index, 3).as_chunks().0,
            )
        })
    }
}

/// The coverage that is allowed next to `alpha`.
fn nearest<T: Real>(alpha: T, own: T, hidden: T) -> T {
    alpha.greater(own).lesser(own + hidden)
}

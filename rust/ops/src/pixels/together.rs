//! All subjects rendered together.

use bigs_raster::{Real, filled_with};
use rayon::prelude::*;

use crate::OpsError;
use crate::pixels::{Frames, RUN, add_run, area, sign};

/// Rendered pictures of all subjects, and what the clip shows. Pixels that are `covered` by something unlabelled do not
/// count.
#[derive(Clone, Debug)]
pub struct Together<'a, T> {
    /// Which frames.
    pub frames: Frames<'a>,
    /// Rendered: three colours, and then a label for each subject, or none.
    pub colors: &'a [T],
    /// Values of a rendered pixel.
    pub channels: usize,
    /// Rendered coverage.
    pub alphas: &'a [T],
    /// The clip's colours.
    pub images: &'a [T],
    /// The share of a pixel that shows any subject.
    pub foreground: &'a [T],
    /// The share that something unlabelled covers.
    pub unknown: &'a [T],
    /// For each label the share that shows the subject.
    pub shares: Vec<&'a [T]>,
    /// A pixel of which more than this is unknown does not count.
    pub covered: f64,
}

/// The terms, and the areas that they are means over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Terms {
    /// |difference| and squared difference of colours, mean over the foreground; squared coverage where nothing is, per
    /// pixel of the foreground; squared difference of labels, per labelled pixel.
    pub values: [f64; 4],
    /// Pixels of foreground that count.
    pub foreground: f64,
    /// Labelled pixels that count.
    pub labelled: f64,
}

/// One picture's arrays.
struct Picture<'a, T> {
    colors: &'a [T],
    alphas: &'a [T],
    images: &'a [[T; 3]],
    foreground: &'a [T],
    unknown: &'a [T],
    shares: Vec<&'a [T]>,
}

impl<T: Real> Together<'_, T> {
    /// # Errors
    /// A length that does not fit, or a frame that the clip does not have.
    pub fn check(&self) -> Result<(), OpsError> {
        self.frames.check()?;
        if self.channels != 3 + self.shares.len() {
            return Err(OpsError::LengthMismatch {
                name: "colors",
                expected: 3 + self.shares.len(),
                got: self.channels,
            });
        }
        self.frames.check_rendered("colors", self.colors, self.channels)?;
        self.frames.check_rendered("alphas", self.alphas, 1)?;
        self.frames.check_clip("images", self.images, 3)?;
        self.frames.check_clip("foreground", self.foreground, 1)?;
        self.frames.check_clip("unknown", self.unknown, 1)?;
        self.shares
            .iter()
            .try_for_each(|share| self.frames.check_clip("shares", share, 1))
    }

    fn picture(&self, index: usize) -> Picture<'_, T> {
        let frames = &self.frames;
        Picture {
            colors: frames.of_rendered(self.colors, index, self.channels),
            alphas: frames.of_rendered(self.alphas, index, 1),
            images: frames.of_clip(self.images, index, 3).as_chunks().0,
            foreground: frames.of_clip(self.foreground, index, 1),
            unknown: frames.of_clip(self.unknown, index, 1),
            shares: self
                .shares
                .iter()
                .map(|share| frames.of_clip(share, index, 1))
                .collect(),
        }
    }

    /// The terms, checked.
    ///
    /// # Errors
    /// As [`Together::check`].
    pub fn terms(&self) -> Result<Terms, OpsError> {
        self.check()?;
        let [absolute, squared, spilled, different, foreground, labelled] =
            self.frames.sums(|index| self.sums(&self.picture(index)));
        let colors = area(3.0 * foreground);
        Ok(Terms {
            values: [
                absolute / colors,
                squared / colors,
                spilled / area(foreground),
                different / area(labelled),
            ],
            foreground,
            labelled,
        })
    }

    fn sums(&self, picture: &Picture<'_, T>) -> [f64; 6] {
        let covered = T::of(self.covered);
        let mut sums = [0.0; 6];
        for first in (0..self.frames.pixels).step_by(RUN) {
            let mut run = [T::ZERO; 6];
            for p in first..(first + RUN).min(self.frames.pixels) {
                let (shown, alpha, unknown) = (picture.foreground[p], picture.alphas[p], picture.unknown[p]);
                if (shown <= T::ZERO && alpha <= T::ZERO) || unknown > covered {
                    continue;
                }
                let color = &picture.colors[p * self.channels..][..self.channels];
                let (mut absolute, mut squared) = (T::ZERO, T::ZERO);
                for c in 0..3 {
                    let difference = color[c] - picture.images[p][c];
                    absolute += difference.abs();
                    squared += difference * difference;
                }
                run[0] += absolute * shown;
                run[1] += squared * shown;
                run[2] += alpha * alpha * empty(shown, unknown);
                for (share, &label) in picture.shares.iter().zip(&color[3..]) {
                    let difference = label - share[p];
                    run[3] += difference * difference;
                    run[5] += share[p];
                }
                run[4] += shown;
            }
            add_run(&mut sums, run);
        }
        sums
    }

    /// Gradients of the rendered colours and of the coverage, from those of the four terms.
    ///
    /// # Errors
    /// As [`Together::check`].
    pub fn vjp(&self, terms: &Terms, v: [f64; 4]) -> Result<(Vec<T>, Vec<T>), OpsError> {
        self.check()?;
        let two = T::of(2.0);
        let colors = area(3.0 * terms.foreground);
        let [absolute, squared, spilled, different] = [
            v[0] / colors,
            v[1] / colors,
            v[2] / area(terms.foreground),
            v[3] / area(terms.labelled),
        ]
        .map(T::of);
        let covered = T::of(self.covered);
        let mut v_colors = filled_with("v_colors", T::ZERO, &[self.colors.len()])?;
        let mut v_alphas = filled_with("v_alphas", T::ZERO, &[self.alphas.len()])?;
        let size = self.frames.pixels.max(1);
        (
            v_colors.par_chunks_exact_mut(size * self.channels),
            v_alphas.par_chunks_exact_mut(size),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(index, (v_colors, v_alphas))| {
                let picture = self.picture(index);
                for p in 0..self.frames.pixels {
                    let (shown, alpha, unknown) =
                        (picture.foreground[p], picture.alphas[p], picture.unknown[p]);
                    if (shown <= T::ZERO && alpha <= T::ZERO) || unknown > covered {
                        continue;
                    }
                    let color = &picture.colors[p * self.channels..][..self.channels];
                    let v_color = &mut v_colors[p * self.channels..][..self.channels];
                    for c in 0..3 {
                        let difference = color[c] - picture.images[p][c];
                        v_color[c] = shown * (absolute * sign(difference) + squared * two * difference);
                    }
                    for (label, share) in picture.shares.iter().enumerate() {
                        v_color[3 + label] = different * two * (color[3 + label] - share[p]);
                    }
                    v_alphas[p] = spilled * two * alpha * empty(shown, unknown);
                }
            });
        Ok((v_colors, v_alphas))
    }
}

/// The share of a pixel that should show nothing.
fn empty<T: Real>(shown: T, unknown: T) -> T {
    (T::ONE - shown - unknown).greater(T::ZERO)
}

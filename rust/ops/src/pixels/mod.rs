//! How far rendered pictures are from a clip's images and masks: every term of a step in one pass over its pixels, and
//! back for gradients. Images and masks are those of the whole clip; a step names the frames that it looks at.

pub mod alone;
pub mod together;

use bigs_raster::Real;
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;

/// Pixels whose sums are added in single precision before they join the others'.
const RUN: usize = 64;

/// The frames of a step, in a clip of pictures of one size.
#[derive(Clone, Copy, Debug)]
pub struct Frames<'a> {
    /// Which of the clip's frames each rendered picture shows.
    pub frames: &'a [usize],
    /// Pixels of a picture.
    pub pixels: usize,
    /// Frames of the clip.
    pub clip: usize,
}

impl Frames<'_> {
    /// # Errors
    /// A frame that the clip does not have.
    fn check(&self) -> Result<(), OpsError> {
        match self.frames.iter().position(|&frame| frame >= self.clip) {
            Some(_) => Err(OpsError::BadSize {
                name: "frames",
                expected: "indices below the number of the clip's frames",
                got: self.frames.iter().copied().max().unwrap_or(0),
            }),
            None => Ok(()),
        }
    }

    /// # Errors
    /// An array of another length than the clip's pixels times `each`.
    fn check_clip<T>(&self, name: &'static str, values: &[T], each: usize) -> Result<(), OpsError> {
        check_length(name, self.clip * self.pixels * each, values.len())
    }

    /// # Errors
    /// An array of another length than the rendered pixels times `each`.
    fn check_rendered<T>(&self, name: &'static str, values: &[T], each: usize) -> Result<(), OpsError> {
        check_length(name, self.frames.len() * self.pixels * each, values.len())
    }

    /// The part of a clip's array that belongs to the rendered picture `index`.
    fn of_clip<'v, T>(&self, values: &'v [T], index: usize, each: usize) -> &'v [T] {
        let size = self.pixels * each;
        values
            .get(self.frames[index] * size..)
            .map_or(&[], |rest| &rest[..size])
    }

    /// The part of a rendered array that belongs to picture `index`.
    fn of_rendered<'v, T>(&self, values: &'v [T], index: usize, each: usize) -> &'v [T] {
        let size = self.pixels * each;
        values.get(index * size..).map_or(&[], |rest| &rest[..size])
    }

    /// Sums of N values over the pictures, in their order.
    fn sums<const N: usize>(&self, of_picture: impl Fn(usize) -> [f64; N] + Send + Sync) -> [f64; N] {
        let pictures: Vec<[f64; N]> = (0..self.frames.len()).into_par_iter().map(of_picture).collect();
        let mut sums = [0.0; N];
        for picture in pictures {
            for (sum, value) in sums.iter_mut().zip(picture) {
                *sum += value;
            }
        }
        sums
    }
}

/// Adds what a run of pixels came to.
fn add_run<T: Real, const N: usize>(sums: &mut [f64; N], run: [T; N]) {
    for (sum, value) in sums.iter_mut().zip(run) {
        *sum += value.as_f64();
    }
}

/// −1, 0 or 1, without branches: in noise half of them would be foreseen wrongly.
fn sign<T: Real>(value: T) -> T {
    let one_if = |holds: bool| if holds { T::ONE } else { T::ZERO };
    one_if(value > T::ZERO) - one_if(value < T::ZERO)
}

/// What a mean divides by: an area of pixels, at least one.
fn area(pixels: f64) -> f64 {
    pixels.max(1.0)
}

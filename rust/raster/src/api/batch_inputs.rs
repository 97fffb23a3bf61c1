//! What a batch of views is made of, and what its views share.

use crate::error::RasterError;
use crate::input::camera::{CameraModel, check_size};
use crate::input::gaussians::{Gaussians, check_channels, check_counts, check_finite, check_length};
use crate::input::settings::RenderMode;
use crate::math::real::Real;
use crate::memory::results::product;

/// Images of a batch at most: shared inputs let a batch of any size fit into little memory.
const MAX_VIEWS: usize = 1 << 20;

/// How many parts an input has along each axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Layout {
    entries: usize,
    cameras: usize,
}

impl Layout {
    pub(crate) fn count(self) -> usize {
        self.entries * self.cameras
    }

    /// Which part a view uses.
    pub(crate) fn index(self, view: usize, cameras: usize) -> usize {
        let (entry, camera) = (view / cameras, view % cameras);
        (if self.entries > 1 { entry } else { 0 }) * self.cameras + if self.cameras > 1 { camera } else { 0 }
    }
}

/// An input of a batch: `entries` × `cameras` parts, one after the other; 1 along either axis is one part that all share.
#[derive(Clone, Copy, Debug)]
pub struct Broadcast<'a, U> {
    /// The values of all parts.
    pub data: &'a [U],
    /// 1, or the number of batch entries.
    pub entries: usize,
    /// 1, or the number of cameras per entry.
    pub cameras: usize,
}

impl<'a, U> Broadcast<'a, U> {
    pub(crate) fn count(&self) -> usize {
        self.layout().count()
    }

    pub(crate) fn layout(&self) -> Layout {
        Layout {
            entries: self.entries,
            cameras: self.cameras,
        }
    }

    pub(crate) fn part(&self, view: usize, cameras: usize) -> &'a [U] {
        let size = self.data.len() / self.count();
        &self.data[self.layout().index(view, cameras) * size..][..size]
    }

    pub(crate) fn check(
        &self,
        name: &'static str,
        shape: &BatchShape,
        elements: usize,
    ) -> Result<(), RasterError> {
        let fits = |have: usize, want: usize| have == 1 || have == want;
        if !fits(self.entries, shape.entries) {
            return check_length(name, shape.entries, self.entries);
        }
        if !fits(self.cameras, shape.cameras) {
            return check_length(name, shape.cameras, self.cameras);
        }
        check_length(
            name,
            product(&[self.entries, self.cameras, elements]),
            self.data.len(),
        )
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
        product(&[self.entries, self.cameras])
    }

    pub(crate) fn pixels(&self) -> usize {
        product(&[self.width, self.height])
    }

    /// Channels of an image in this mode.
    pub fn image_channels(&self, mode: RenderMode) -> usize {
        mode.channels(self.channels)
    }

    /// Whether everything that a batch of these sizes counts can be numbered, so that no product below overflows.
    pub(crate) fn check(&self, mode: RenderMode) -> Result<(), RasterError> {
        check_counts(self.gaussians, self.channels)?;
        check_channels(mode, self.channels)?;
        check_size(self.width, self.height)?;
        let views = self.views();
        if views > MAX_VIEWS {
            return Err(RasterError::BadSize {
                name: "batch",
                expected: "at most 2^20 images",
                got: views,
            });
        }
        // Bytes of the widest arrays: `f64` images, and four numbers or colours per Gaussian.
        let numbers = [self.image_channels(mode), self.channels, 16]
            .into_iter()
            .max()
            .unwrap_or(16);
        let largest = product(&[views, 8, numbers, self.pixels().max(self.gaussians)]);
        if largest > isize::MAX as usize {
            return Err(RasterError::BadSize {
                name: "batch",
                expected: "entries and cameras whose images fit into the address space",
                got: views,
            });
        }
        Ok(())
    }
}

/// The Gaussians of a batch, one row each in every part.
#[derive(Clone, Copy, Debug)]
pub struct BatchGaussians<'a, T> {
    /// Centres, 3 per Gaussian.
    pub means: Broadcast<'a, T>,
    /// Rotations w x y z, 4 per Gaussian.
    pub quats: Broadcast<'a, T>,
    /// Standard deviations, 3 per Gaussian.
    pub scales: Broadcast<'a, T>,
    /// Opacities.
    pub opacities: Broadcast<'a, T>,
    /// Colours, `channels` per Gaussian.
    pub colors: Broadcast<'a, T>,
}

impl<'a, T: Real> BatchGaussians<'a, T> {
    /// Each array with its name and its values per part.
    pub(crate) fn arrays(&self, shape: &BatchShape) -> [(&'static str, Broadcast<'a, T>, usize); 5] {
        let n = shape.gaussians;
        [
            ("means", self.means, 3 * n),
            ("quats", self.quats, 4 * n),
            ("scales", self.scales, 3 * n),
            ("opacities", self.opacities, n),
            ("colors", self.colors, shape.channels * n),
        ]
    }

    /// Whether every array has the length that the shape asks for.
    pub(crate) fn check_lengths(&self, shape: &BatchShape) -> Result<(), RasterError> {
        for (name, input, elements) in self.arrays(shape) {
            input.check(name, shape, elements)?;
        }
        Ok(())
    }

    /// Whether every value is finite.
    pub(crate) fn check_values(&self, shape: &BatchShape) -> Result<(), RasterError> {
        for (name, input, _) in self.arrays(shape) {
            check_finite(name, input.data)?;
        }
        Ok(())
    }

    /// Those of a view.
    pub(crate) fn of_view(&self, view: usize, shape: &BatchShape) -> Gaussians<'a, T> {
        let cameras = shape.cameras;
        Gaussians {
            means: self.means.part(view, cameras).as_chunks().0,
            quats: self.quats.part(view, cameras).as_chunks().0,
            scales: self.scales.part(view, cameras).as_chunks().0,
            opacities: self.opacities.part(view, cameras),
            colors: self.colors.part(view, cameras),
            channels: shape.channels,
            harmonics: None,
        }
    }
}

/// The inputs of a batch. `viewmats` are 4×4 row-major matrices, `ks` 3×3.
#[derive(Clone, Copy, Debug)]
pub struct BatchInputs<'a, T> {
    /// What is rendered.
    pub gaussians: BatchGaussians<'a, T>,
    /// World-to-camera matrices.
    pub viewmats: Broadcast<'a, T>,
    /// Camera matrices.
    pub ks: Broadcast<'a, T>,
    /// How every camera projects.
    pub camera_model: CameraModel,
    /// One value per channel.
    pub backgrounds: Option<Broadcast<'a, T>>,
    /// One value per pixel; false is not rendered.
    pub pixel_mask: Option<Broadcast<'a, bool>>,
}

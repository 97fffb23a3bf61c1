//! What a batch of views is made of, and what its views share.

use crate::error::RasterError;
use crate::input::camera::CameraModel;
use crate::input::gaussians::check_length;
use crate::input::settings::RenderMode;

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
    pub(crate) fn count(&self) -> usize {
        self.entries * self.cameras
    }

    /// Which slab a view uses.
    pub(crate) fn index(&self, view: usize, cameras: usize) -> usize {
        let (entry, camera) = (view / cameras, view % cameras);
        (if self.entries > 1 { entry } else { 0 }) * self.cameras + if self.cameras > 1 { camera } else { 0 }
    }

    pub(crate) fn slab(&self, view: usize, cameras: usize) -> &'a [U] {
        let size = self.data.len() / self.count();
        &self.data[self.index(view, cameras) * size..][..size]
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

    pub(crate) fn pixels(&self) -> usize {
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

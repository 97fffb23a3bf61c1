//! Cameras that look at a point from around it.

use bigs_raster::glam::Vec3;
use bigs_raster::{Camera, CameraModel, Intrinsics, RasterError};

/// A direction along an axis of the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Axis {
    pub(crate) index: usize,
    pub(crate) sign: f32,
}

impl Axis {
    /// `x`, `-x`, `y` and so on.
    pub(crate) fn parse(text: &str) -> Option<Self> {
        let (sign, name) = match text.strip_prefix('-') {
            Some(name) => (-1.0, name),
            None => (1.0, text.strip_prefix('+').unwrap_or(text)),
        };
        let index = ["x", "y", "z"].iter().position(|&axis| axis == name)?;
        Some(Self { index, sign })
    }
}

/// Where a camera stands: angles in degrees, azimuth about `up`, elevation above the plane across it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Orbit {
    pub(crate) centre: [f32; 3],
    pub(crate) distance: f32,
    pub(crate) azimuth: f32,
    pub(crate) elevation: f32,
    pub(crate) up: Axis,
}

impl Orbit {
    /// The camera, with its vertical field of view in degrees and the principal point in the middle. An orthographic
    /// one shows what a pinhole camera would at the distance of the centre.
    pub(crate) fn camera(
        &self,
        model: CameraModel,
        fov: f32,
        width: usize,
        height: usize,
    ) -> Result<Camera<f32>, RasterError> {
        let mut k = Intrinsics::from_fov_y(fov.to_radians(), width, height);
        if model == CameraModel::Orthographic {
            (k.fx, k.fy) = (k.fx / self.distance, k.fy / self.distance);
        }
        let mut up = [0.0; 3];
        up[self.up.index] = self.up.sign;
        let angles = [self.azimuth.to_radians(), self.elevation.to_radians()];
        let (centre, up) = (Vec3::from(self.centre), Vec3::from(up));
        Ok(Camera::orbit(centre, self.distance, angles, up, k, width, height)?.with_model(model))
    }
}

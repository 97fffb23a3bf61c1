//! Cameras that look at a point from around it.

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
    /// A vector from (one axis across up, the other, up): right-handed whichever way up points.
    fn world(&self, [a, b, up]: [f32; 3]) -> [f32; 3] {
        let mut v = [0.0; 3];
        v[self.up.index] = self.up.sign * up;
        v[(self.up.index + 1) % 3] = a;
        v[(self.up.index + 2) % 3] = self.up.sign * b;
        v
    }

    /// Where the camera is.
    pub(crate) fn eye(&self) -> [f32; 3] {
        let (sin_azimuth, cos_azimuth) = self.azimuth.to_radians().sin_cos();
        let (sin_elevation, cos_elevation) = self.elevation.to_radians().sin_cos();
        let out = self.world([
            cos_elevation * cos_azimuth,
            cos_elevation * sin_azimuth,
            sin_elevation,
        ]);
        [0, 1, 2].map(|k| self.centre[k] + self.distance * out[k])
    }

    /// The camera, with its vertical field of view in degrees and the principal point in the middle. An orthographic
    /// one shows what a pinhole camera would at the distance of the centre.
    pub(crate) fn camera(
        &self,
        model: CameraModel,
        fov: f32,
        width: usize,
        height: usize,
    ) -> Result<Camera<f32>, RasterError> {
        let (sin_azimuth, cos_azimuth) = self.azimuth.to_radians().sin_cos();
        let (sin_elevation, cos_elevation) = self.elevation.to_radians().sin_cos();
        let forward = self.world([
            -cos_elevation * cos_azimuth,
            -cos_elevation * sin_azimuth,
            -sin_elevation,
        ]);
        let right = self.world([-sin_azimuth, cos_azimuth, 0.0]);
        let down = self.world([
            sin_elevation * cos_azimuth,
            sin_elevation * sin_azimuth,
            -cos_elevation,
        ]);
        let eye = self.eye();
        let row = |axis: [f32; 3]| {
            let shift = axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2];
            [axis[0], axis[1], axis[2], -shift]
        };
        let viewmat = [row(right), row(down), row(forward), [0.0, 0.0, 0.0, 1.0]];
        let focal = height as f32 / 2.0 / (fov.to_radians() / 2.0).tan();
        let scale = if model == CameraModel::Orthographic {
            focal / self.distance
        } else {
            focal
        };
        let k = Intrinsics {
            fx: scale,
            fy: scale,
            cx: width as f32 / 2.0,
            cy: height as f32 / 2.0,
        };
        Ok(Camera::new(viewmat, k, width, height)?.with_model(model))
    }
}

//! Where everything is thought to be, and the camera that looks at it.

use crate::TrackError;
use crate::bundle::Sightings;

/// Least depth that a place is divided by.
const LEAST_DEPTH: f64 = 1e-6;

/// Poses of T frames, P points, and the camera.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// T, object to camera, row by row.
    pub rotations: &'a [[f64; 9]],
    /// T.
    pub transl: &'a [[f64; 3]],
    /// P, in the object's frame, by rank.
    pub points: &'a [[f64; 3]],
    /// Focal lengths right and down, pixels.
    pub focal: [f64; 2],
    /// Principal point, pixels.
    pub middle: [f64; 2],
    /// Scale of Cauchy's loss, pixels.
    pub sigma: f64,
}

/// Where a frame sees a point.
pub(crate) struct Place {
    /// From the object's origin to the point, along the camera's axes.
    pub(crate) arm: [f64; 3],
    pub(crate) depth: f64,
    /// Right and down, as shares of the depth.
    pub(crate) ray: [f64; 2],
    /// By how much it is off in the picture, pixels.
    pub(crate) off: [f64; 2],
}

impl Scene<'_> {
    pub(crate) fn check(&self, seen: &Sightings) -> Result<(), TrackError> {
        for (what, expected, found) in [
            ("rotations", seen.frames(), self.rotations.len()),
            ("transl", seen.frames(), self.transl.len()),
            ("points", seen.points(), self.points.len()),
        ] {
            TrackError::check_length(what, expected, found)?;
        }
        Ok(())
    }

    #[inline(always)]
    pub(crate) fn place(&self, frame: usize, point: usize, pixel: [f64; 2]) -> Place {
        let [x, y, z] = self.points[point];
        let turn = &self.rotations[frame];
        let arm: [f64; 3] = [0, 3, 6].map(|row| turn[row] * x + turn[row + 1] * y + turn[row + 2] * z);
        let shift = self.transl[frame];
        let depth = arm[2] + shift[2];
        // What is no number is clamped, too.
        let depth = if depth > LEAST_DEPTH { depth } else { LEAST_DEPTH };
        let ray = [(arm[0] + shift[0]) / depth, (arm[1] + shift[1]) / depth];
        let off = [0, 1].map(|i| self.focal[i] * ray[i] + self.middle[i] - pixel[i]);
        Place { arm, depth, ray, off }
    }
}

use crate::{ShapeError, Vec3};

/// Nearer than this a point is not before the camera, metres.
const NEAREST: f64 = 1e-3;

/// An object's pose in each of T pictures: x = R p + centre in the camera.
#[derive(Clone, Copy, Debug)]
pub struct Views<'a> {
    /// Of every picture, pixels.
    pub width: usize,
    /// Of every picture, pixels.
    pub height: usize,
    /// Focal lengths, pixels.
    pub focal: [f64; 2],
    /// The principal point; the first pixel's middle is at (0.5, 0.5).
    pub middle: [f64; 2],
    /// T rotations, row by row.
    pub rotations: &'a [[f64; 9]],
    /// T centres, metres.
    pub centers: &'a [Vec3],
}

impl Views<'_> {
    /// # Errors
    /// Poses of another number, or pictures of another size.
    pub(crate) fn check(&self, what: &str, pixels: usize) -> Result<(), ShapeError> {
        ShapeError::check("rotations", self.centers.len(), self.rotations.len())?;
        let expected = self.centers.len() * self.width * self.height;
        ShapeError::check(what, expected, pixels)
    }

    /// The point in the camera of picture `t`.
    pub(crate) fn camera(&self, t: usize, p: Vec3) -> Vec3 {
        let (r, c) = (&self.rotations[t], &self.centers[t]);
        [0, 1, 2].map(|i| r[3 * i] * p[0] + r[3 * i + 1] * p[1] + r[3 * i + 2] * p[2] + c[i])
    }

    /// Column and row of a point in the camera, where the first pixel's middle is at (0, 0); none on or behind it.
    pub(crate) fn place(&self, camera: Vec3) -> Option<[f64; 2]> {
        let depth = camera[2];
        let per_depth = 1.0 / depth;
        (depth > NEAREST)
            .then(|| [0, 1].map(|i| self.focal[i] * camera[i] * per_depth + self.middle[i] - 0.5))
    }

    /// Index of the pixel that a point in the camera falls on, if it is in the picture.
    pub(crate) fn pixel(&self, camera: Vec3) -> Option<usize> {
        let [column, row] = self.place(camera)?.map(|place| place + 0.5);
        // What is not negative is cut to whole numbers as `floor` would, which takes longer.
        let inside = column >= 0.0 && row >= 0.0 && column < self.width as f64 && row < self.height as f64;
        inside.then(|| row as usize * self.width + column as usize)
    }
}

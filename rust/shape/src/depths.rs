//! What of a surface shows in pictures, by the nearest depths of its samples.

use rayon::prelude::*;

use crate::{ShapeError, Vec3, Views};

/// A sample also covers this many pixels on either side, so that no gap shows what lies behind.
const CLOSED: usize = 2;

/// Surface that faces the camera, and how it counts as seen.
#[derive(Clone, Copy, Debug)]
pub struct Facing<'a> {
    /// Unit, outward, one for each point.
    pub normals: &'a [Vec3],
    /// Surface that is turned away further is seen at a glancing angle only.
    pub least_cosine: f64,
}

impl Views<'_> {
    /// In how many pictures points of a surface show: they face the camera, their pixel of `shown` (T × H × W) is true,
    /// and nothing of `surface` is nearer there by more than `tolerance`.
    ///
    /// # Errors
    /// A length that does not fit.
    pub fn times_seen(
        &self,
        shown: &[bool],
        points: &[Vec3],
        facing: &Facing<'_>,
        surface: &[Vec3],
        tolerance: f64,
    ) -> Result<Vec<u32>, ShapeError> {
        ShapeError::check("normals", points.len(), facing.normals.len())?;
        let per_pixel = CLOSED as f64 / self.focal[0];
        self.count(shown, points, surface, |t, index, camera, nearest| {
            let r = &self.rotations[t];
            let n = &facing.normals[index];
            // The cosine between the normal and the way to the camera, both in the camera's axes.
            let along: f64 = (0..3)
                .map(|i| camera[i] * (r[3 * i] * n[0] + r[3 * i + 1] * n[1] + r[3 * i + 2] * n[2]))
                .sum();
            let away: f64 = camera.iter().map(|x| x * x).sum();
            let cosine = -along / away.sqrt();
            if !(cosine > facing.least_cosine) {
                return false;
            }
            // The nearest depth of some pixels around is, on a slope, nearer than the point's own.
            let cosine = cosine.min(1.0);
            let slope = (1.0 - cosine * cosine).sqrt() / cosine;
            camera[2] < nearest + per_pixel * camera[2] * slope + tolerance
        })
    }

    /// In how many pictures points would hide, by more than `tolerance`, a `surface` whose pixel of `shown` is true.
    ///
    /// # Errors
    /// A length that does not fit.
    pub fn times_empty(
        &self,
        shown: &[bool],
        points: &[Vec3],
        surface: &[Vec3],
        tolerance: f64,
    ) -> Result<Vec<u32>, ShapeError> {
        self.count(shown, points, surface, |_, _, camera, nearest| {
            nearest.is_finite() && camera[2] < nearest - tolerance
        })
    }

    /// In how many pictures something holds of points on true pixels of `shown`; it is asked for the picture, the point's
    /// index, its place in the camera and the nearest depth of the surface there.
    fn count(
        &self,
        shown: &[bool],
        points: &[Vec3],
        surface: &[Vec3],
        holds: impl Fn(usize, usize, Vec3, f64) -> bool + Sync,
    ) -> Result<Vec<u32>, ShapeError> {
        self.check("shown", shown.len())?;
        let pixels = self.width * self.height;
        let of_frames = |mut counts: Vec<u32>, t: usize| {
            let nearest = self.nearest_depths(t, surface);
            let shown = &shown[t * pixels..][..pixels];
            for (index, (&point, count)) in points.iter().zip(&mut counts).enumerate() {
                let camera = self.camera(t, point);
                let found = self
                    .pixel(camera)
                    .is_some_and(|pixel| shown[pixel] && holds(t, index, camera, nearest[pixel]));
                *count += u32::from(found);
            }
            counts
        };
        // Counts are whole numbers, whose sum has no order.
        Ok((0..self.centers.len())
            .into_par_iter()
            .fold(|| vec![0; points.len()], of_frames)
            .reduce(
                || vec![0; points.len()],
                |mut all, some| {
                    for (sum, count) in all.iter_mut().zip(some) {
                        *sum += count;
                    }
                    all
                },
            ))
    }

    /// The nearest depth of surface samples in and about each pixel; infinite where there is none.
    fn nearest_depths(&self, t: usize, surface: &[Vec3]) -> Vec<f64> {
        let mut buffer = vec![f64::INFINITY; self.width * self.height];
        for &point in surface {
            let camera = self.camera(t, point);
            if let Some(pixel) = self.pixel(camera) {
                buffer[pixel] = buffer[pixel].min(camera[2]);
            }
        }
        let mut wide = vec![f64::INFINITY; buffer.len()];
        for (out, row) in wide
            .chunks_exact_mut(self.width.max(1))
            .zip(buffer.chunks_exact(self.width.max(1)))
        {
            widen(out, row, 1);
        }
        widen(&mut buffer, &wide, self.width);
        buffer
    }
}

/// The least of each value and of those up to `CLOSED` strides before and after it.
fn widen(out: &mut [f64], values: &[f64], stride: usize) {
    out.copy_from_slice(values);
    for far in (1..=CLOSED).map(|steps| steps * stride) {
        let Some(later) = values.get(far..) else {
            continue;
        };
        for (least, &value) in out.iter_mut().zip(later) {
            *least = if value < *least { value } else { *least };
        }
        for (least, &value) in out[far..].iter_mut().zip(values) {
            *least = if value < *least { value } else { *least };
        }
    }
}

//! The visual hull: what the cones over all silhouettes have in common.

use rayon::prelude::*;

use crate::{ShapeError, Vec3, Views};

/// Neighbouring points fall on neighbouring pixels, so a picture is read for this many of them at a time.
const PIECE: usize = 8192;

/// How far points are from the cones, and when that is known.
#[derive(Clone, Copy, Debug)]
pub struct Cones<'a> {
    /// T × H × W signed distances to the silhouettes' borders in pixels, negative inside.
    pub silhouettes: &'a [f32],
    /// The order in which pictures are looked at: each once.
    pub order: &'a [usize],
    /// How many pictures must agree that a point is outside, at least 1.
    pub agreeing: usize,
    /// A point that is further outside is not looked at again.
    pub stop: f64,
}

impl Views<'_> {
    /// Distances of points to the hull in their own unit, negative inside: the largest to any cone, or the largest that
    /// enough pictures agree on. A point that fewer see is inside by 1.
    ///
    /// # Errors
    /// A length that does not fit.
    pub fn cones(&self, cones: &Cones<'_>, points: &[Vec3]) -> Result<Vec<f64>, ShapeError> {
        self.check("silhouettes", cones.silhouettes.len())?;
        ShapeError::check("order", self.centers.len(), cones.order.len())?;
        let mut distances = vec![0.0; points.len()];
        (points.par_chunks(PIECE), distances.par_chunks_mut(PIECE))
            .into_par_iter()
            .for_each(|(points, distances)| self.of_piece(cones, points, distances));
        Ok(distances)
    }

    fn of_piece(&self, cones: &Cones<'_>, points: &[Vec3], distances: &mut [f64]) {
        let agreeing = cones.agreeing.max(1);
        let pixels = self.width * self.height;
        // Of each point the largest found so far, descending; the last one counts.
        let mut largest = vec![f64::NEG_INFINITY; agreeing * points.len()];
        let mut active: Vec<usize> = (0..points.len()).collect();
        for &t in cones.order.iter().filter(|&&t| t < self.centers.len()) {
            let silhouette = &cones.silhouettes[t * pixels..][..pixels];
            active.retain(|&index| {
                let largest = &mut largest[index * agreeing..][..agreeing];
                if let Some(found) = self.beyond_cone(t, silhouette, points[index]) {
                    insert(largest, found);
                }
                largest[agreeing - 1] <= cones.stop
            });
        }
        for (distance, largest) in distances.iter_mut().zip(largest.chunks_exact(agreeing)) {
            let last = largest[agreeing - 1];
            *distance = if last.is_finite() { last } else { -1.0 };
        }
    }

    /// The distance of a point to one cone, if the picture shows its place.
    fn beyond_cone(&self, t: usize, silhouette: &[f32], point: Vec3) -> Option<f64> {
        let camera = self.camera(t, point);
        let [u, v] = self.place(camera)?;
        let shows = u > 0.0 && v > 0.0 && u < (self.width - 1) as f64 && v < (self.height - 1) as f64;
        if !shows {
            return None;
        }
        let (column, row) = (u as usize, v as usize);
        let (right, down) = (u - column as f64, v - row as f64);
        let start = row * self.width + column;
        let upper = [silhouette[start], silhouette[start + 1]].map(f64::from);
        let lower = [silhouette[start + self.width], silhouette[start + self.width + 1]].map(f64::from);
        let mix = |[a, b]: [f64; 2], share: f64| a + share * (b - a);
        Some(mix([mix(upper, right), mix(lower, right)], down) * camera[2] / self.focal[0])
    }
}

/// Puts a value in its place among some in descending order, of which the least falls out.
fn insert(largest: &mut [f64], value: f64) {
    let mut place = largest.len();
    while place > 0 && value > largest[place - 1] {
        if place < largest.len() {
            largest[place] = largest[place - 1];
        }
        place -= 1;
    }
    if place < largest.len() {
        largest[place] = value;
    }
}

//! Signed distances from an object's surface, sampled from a grid in the object's own frame.

use bigs_raster::Real;
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;

/// Points that one thread takes at a time.
const PIECE: usize = 1024;

/// A grid of signed distances, at least two values along each axis.
#[derive(Clone, Copy, Debug)]
pub struct Grid<'a, T> {
    /// Z × Y × X, the last axis fastest.
    pub values: &'a [T],
    /// Values along x, y and z.
    pub size: [usize; 3],
    /// The first and the last value's place.
    pub bounds: [[T; 3]; 2],
}

/// A grid whose size was checked, and what all samples share.
#[derive(Clone, Copy)]
pub(crate) struct Sampler<'a, T> {
    grid: Grid<'a, T>,
    /// Steps between values in one unit of length.
    steps: [T; 3],
}

impl<'a, T: Real> Grid<'a, T> {
    /// Distances of points in the grid's frame, negative inside. Outside the grid, the distance to its box is added.
    ///
    /// # Errors
    /// A length that does not fit, or a grid without room between its values.
    pub fn distances(&self, points: &[[T; 3]]) -> Result<Vec<T>, OpsError> {
        let sampler = self.sampler()?;
        let mut out = vec![T::ZERO; points.len()];
        (points.par_chunks(PIECE), out.par_chunks_mut(PIECE))
            .into_par_iter()
            .for_each(|(points, out)| {
                for (&point, out) in points.iter().zip(out) {
                    *out = sampler.distance(point);
                }
            });
        Ok(out)
    }

    pub(crate) fn sampler(&self) -> Result<Sampler<'a, T>, OpsError> {
        let [x, y, z] = self.size;
        check_length("values", x * y * z, self.values.len())?;
        if x.min(y).min(z) < 2 {
            return Err(OpsError::BadSize {
                name: "values",
                expected: "at least two along each axis",
                got: x.min(y).min(z),
            });
        }
        let [lower, upper] = self.bounds;
        let steps = [0, 1, 2].map(|i| T::of((self.size[i] - 1) as f64) / (upper[i] - lower[i]));
        Ok(Sampler { grid: *self, steps })
    }
}

impl<T: Real> Sampler<'_, T> {
    /// The distance in the grid's own unit.
    #[inline]
    pub(crate) fn distance(&self, p: [T; 3]) -> T {
        self.sample(p).0
    }

    /// The distance and its slope.
    #[inline(always)]
    pub(crate) fn sample(&self, p: [T; 3]) -> (T, [T; 3]) {
        let Grid { values, size, bounds } = self.grid;
        let [lower, upper] = bounds;
        let (mut first, mut share, mut per) = ([0; 3], [T::ZERO; 3], [T::ZERO; 3]);
        let mut beyond = [T::ZERO; 3];
        for i in 0..3 {
            let inside = p[i].limit(lower[i], upper[i]);
            beyond[i] = p[i] - inside;
            let place = (inside - lower[i]) * self.steps[i];
            // A point that is not finite reads the first value; its own distance is not finite either.
            first[i] = (place.as_f64() as usize).min(size[i] - 2);
            share[i] = place - T::of(first[i] as f64);
            // Where the point is moved to the box, the value does not change with it.
            per[i] = if beyond[i] == T::ZERO {
                self.steps[i]
            } else {
                T::ZERO
            };
        }
        let [x, y, _] = size;
        let start = (first[2] * y + first[1]) * x + first[0];
        let value = |k: usize, j: usize, i: usize| values[start + (k * y + j) * x + i];
        let [sx, sy, sz] = share;
        let mix = |a: T, b: T, s: T| a + s * (b - a);
        let rows = |k: usize| {
            let near = [value(k, 0, 0), value(k, 0, 1)];
            let far = [value(k, 1, 0), value(k, 1, 1)];
            let (a, b) = (mix(near[0], near[1], sx), mix(far[0], far[1], sx));
            let along_x = mix(near[1] - near[0], far[1] - far[0], sy);
            (mix(a, b, sy), along_x, b - a)
        };
        let ((v0, x0, y0), (v1, x1, y1)) = (rows(0), rows(1));
        // A small number under the root keeps the slope finite inside the box.
        let away =
            (beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2] + T::of(1e-12)).sqrt();
        let slope = [mix(x0, x1, sz), mix(y0, y1, sz), v1 - v0];
        (
            mix(v0, v1, sz) + away,
            [0, 1, 2].map(|i| slope[i] * per[i] + beyond[i] / away),
        )
    }
}

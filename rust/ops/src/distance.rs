//! Signed distances of points in camera space from an object that moves, read from a grid in the object's own frame.

use bigs_raster::Real;
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;

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

/// Points of B frames and the object's pose in each: x = scale · R p + centre.
#[derive(Clone, Copy, Debug)]
pub struct Distances<'a, T> {
    /// The object's grid.
    pub grid: Grid<'a, T>,
    /// B × V.
    pub points: &'a [[T; 3]],
    /// B rotations, row by row.
    pub rotations: &'a [[T; 9]],
    /// B.
    pub centers: &'a [[T; 3]],
    /// For the whole clip.
    pub scale: T,
}

/// The distances, and what their gradients need.
#[derive(Clone, Debug, PartialEq)]
pub struct Measured<T> {
    /// B × V, in the unit of the points.
    pub distances: Vec<T>,
    /// B × V slopes in the object's frame.
    slopes: Vec<[T; 3]>,
}

/// Gradients of all inputs but the grid.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct DistanceGradients<T> {
    pub points: Vec<[T; 3]>,
    pub rotations: Vec<[T; 9]>,
    pub centers: Vec<[T; 3]>,
    pub scale: T,
}

impl<T: Real> Grid<'_, T> {
    /// The distance in the grid's own unit, and its slope. Outside the grid, the distance to its box is added.
    fn at(&self, p: [T; 3]) -> (T, [T; 3]) {
        let [lower, upper] = self.bounds;
        let (mut first, mut share, mut per) = ([0; 3], [T::ZERO; 3], [T::ZERO; 3]);
        let mut beyond = [T::ZERO; 3];
        for i in 0..3 {
            let inside = p[i].limit(lower[i], upper[i]);
            beyond[i] = p[i] - inside;
            let steps = T::of((self.size[i] - 1) as f64) / (upper[i] - lower[i]);
            let place = (inside - lower[i]) * steps;
            // A point that is not finite reads the first value; its own distance is not finite either.
            first[i] = (place.as_f64() as usize).min(self.size[i] - 2);
            share[i] = place - T::of(first[i] as f64);
            // Where the point is moved to the box, the value does not change with it.
            per[i] = if beyond[i] == T::ZERO { steps } else { T::ZERO };
        }
        let [x, y, _] = self.size;
        let start = (first[2] * y + first[1]) * x + first[0];
        let value = |k: usize, j: usize, i: usize| self.values[start + (k * y + j) * x + i];
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

impl<T: Real> Distances<'_, T> {
    fn check(&self) -> Result<usize, OpsError> {
        let frames = self.centers.len();
        let [x, y, z] = self.grid.size;
        check_length("values", x * y * z, self.grid.values.len())?;
        if x.min(y).min(z) < 2 {
            return Err(OpsError::BadSize {
                name: "values",
                expected: "at least two along each axis",
                got: x.min(y).min(z),
            });
        }
        check_length("rotations", frames, self.rotations.len())?;
        let each = self.points.len() / frames.max(1);
        check_length("points", frames * each, self.points.len())?;
        Ok(each.max(1))
    }

    /// A point in the object's frame.
    fn own(&self, frame: usize, point: [T; 3]) -> [T; 3] {
        let (r, c) = (&self.rotations[frame], &self.centers[frame]);
        let away = [0, 1, 2].map(|i| point[i] - c[i]);
        [0, 1, 2].map(|j| (r[j] * away[0] + r[3 + j] * away[1] + r[6 + j] * away[2]) / self.scale)
    }

    /// Signed distances, negative inside.
    ///
    /// # Errors
    /// A length that does not fit, or a grid without room between its values.
    pub fn measure(&self) -> Result<Measured<T>, OpsError> {
        let each = self.check()?;
        let mut out = Measured {
            distances: vec![T::ZERO; self.points.len()],
            slopes: vec![[T::ZERO; 3]; self.points.len()],
        };
        (
            self.points.par_chunks_exact(each),
            out.distances.par_chunks_exact_mut(each),
            out.slopes.par_chunks_exact_mut(each),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(frame, (points, distances, slopes))| {
                for ((&point, distance), slope) in points.iter().zip(distances).zip(slopes) {
                    let (value, own) = self.grid.at(self.own(frame, point));
                    (*distance, *slope) = (self.scale * value, own);
                }
            });
        Ok(out)
    }

    /// Gradients from those of the distances.
    ///
    /// # Errors
    /// As [`Distances::measure`], and gradients or measures of another length.
    pub fn vjp(&self, measured: &Measured<T>, v: &[T]) -> Result<DistanceGradients<T>, OpsError> {
        let each = self.check()?;
        check_length("v_distances", self.points.len(), v.len())?;
        check_length("distances", self.points.len(), measured.distances.len())?;
        let frames = self.centers.len();
        let mut out = DistanceGradients {
            points: vec![[T::ZERO; 3]; self.points.len()],
            rotations: vec![[T::ZERO; 9]; frames],
            centers: vec![[T::ZERO; 3]; frames],
            scale: T::ZERO,
        };
        let scales: Vec<T> = (
            out.points.par_chunks_exact_mut(each),
            &mut out.rotations,
            &mut out.centers,
        )
            .into_par_iter()
            .enumerate()
            .map(|(frame, (v_points, v_rotation, v_center))| {
                let mut v_scale = T::ZERO;
                for (at, v_point) in v_points.iter_mut().enumerate() {
                    let index = frame * each + at;
                    // Few vertices touch, and only those pull.
                    if v[index] == T::ZERO {
                        continue;
                    }
                    let own = self.own(frame, self.points[index]);
                    // scale · slope / scale: of the point turned into the object's frame.
                    let pull = measured.slopes[index].map(|slope| v[index] * slope);
                    v_scale += v[index] * measured.distances[index] / self.scale
                        - (pull[0] * own[0] + pull[1] * own[1] + pull[2] * own[2]);
                    let rotation = &self.rotations[frame];
                    for i in 0..3 {
                        let away = self.points[index][i] - self.centers[frame][i];
                        let row = &rotation[3 * i..][..3];
                        v_point[i] = row[0] * pull[0] + row[1] * pull[1] + row[2] * pull[2];
                        v_center[i] += -v_point[i];
                        for j in 0..3 {
                            v_rotation[3 * i + j] += away * pull[j];
                        }
                    }
                }
                v_scale
            })
            .collect();
        out.scale = scales.into_iter().sum();
        Ok(out)
    }
}

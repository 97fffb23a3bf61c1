//! The share of each pixel that a posed mesh covers, and how it changes with the mesh.
//!
//! What a mesh covers ends at its outline, so only the outline moves a share: where a line of samples ends at an edge, the
//! share changes as the end moves. No surface has to be made soft for a gradient.

mod bits;
mod edges;
mod pulls;

use bigs_raster::{Real, filled_with};
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;
use bits::{Bits, Point, SAMPLES};
use edges::{Edges, facings};
use pulls::{Outline, Taken};

/// What is nearer to the camera's plane than this is not seen, in the points' unit.
const NEAREST: f64 = 1e-3;

/// A mesh in B frames, as a camera sees it.
#[derive(Clone, Copy, Debug)]
pub struct Mesh<'a, T> {
    /// How many frames there are.
    pub frames: usize,
    /// B × V vertices in camera space.
    pub points: &'a [[T; 3]],
    /// Vertices of each triangle; their order does not matter.
    pub faces: &'a [[usize; 3]],
    /// The first two rows of the camera's matrix.
    pub intrinsics: [[T; 3]; 2],
    /// Width and height of the picture in pixels.
    pub size: [usize; 2],
}

/// What a mesh covers in each frame.
#[derive(Clone, Debug)]
pub struct Covered {
    frames: Vec<Bits>,
}

impl<T: Real> Mesh<'_, T> {
    /// What the mesh covers.
    ///
    /// # Errors
    /// A length that does not fit, a vertex that there is not, a point that is not finite, no memory.
    pub fn cover(&self) -> Result<Covered, OpsError> {
        let each = self.check()?;
        if let Some(index) = self
            .points
            .as_flattened()
            .iter()
            .position(|v| !v.as_f64().is_finite())
        {
            return Err(OpsError::NotFinite {
                name: "points",
                index,
            });
        }
        let mut frames = (0..self.frames)
            .map(|_| Bits::empty(self.size))
            .collect::<Result<Vec<_>, _>>()?;
        let edges = Edges::of(self.faces, each)?;
        frames.par_iter_mut().enumerate().for_each(|(frame, bits)| {
            let seen = self.seen(frame, each);
            let mut crossings = Vec::new();
            for (ends, beside) in edges.beside(&facings(self.faces, &seen)) {
                if beside.net != 0
                    && let [Some(a), Some(b)] = ends.map(|end| seen[end])
                {
                    bits.cross([a, b], beside.net, &mut crossings);
                }
            }
            bits.fill(crossings);
        });
        Ok(Covered { frames })
    }

    /// The gradient of the points, B × V, from that of the shares, B × H × W.
    ///
    /// # Errors
    /// A length that does not fit, or a vertex that there is not.
    pub fn vjp(&self, covered: &Covered, v_shares: &[T]) -> Result<Vec<[T; 3]>, OpsError> {
        let each = self.check()?;
        let pixels = self.size[0] * self.size[1];
        check_length("covered", self.frames, covered.frames.len())?;
        if let Some(other) = covered.frames.iter().find(|bits| bits.size != self.size) {
            check_length("covered", pixels, other.size[0] * other.size[1])?;
            return Err(OpsError::BadSize {
                name: "covered",
                expected: "the mesh's own picture",
                got: other.size[0],
            });
        }
        check_length("v_shares", self.frames * pixels, v_shares.len())?;
        let mut out = filled_with("gradient of points", [T::ZERO; 3], &[self.frames, each])?;
        if each == 0 || pixels == 0 {
            return Ok(out);
        }
        let edges = Edges::of(self.faces, each)?;
        (
            out.par_chunks_exact_mut(each),
            &covered.frames,
            v_shares.par_chunks_exact(pixels),
        )
            .into_par_iter()
            .enumerate()
            .for_each_init(Taken::default, |taken, (frame, (out, bits, v))| {
                let seen = self.seen(frame, each);
                let mut outline = Outline::new(bits, v, each, taken);
                for (ends, beside) in edges.beside(&facings(self.faces, &seen)) {
                    if beside.side != 0
                        && let [Some(a), Some(b)] = ends.map(|end| seen[end])
                    {
                        outline.add(ends, [a, b], beside.side);
                    }
                }
                let points = &self.points[frame * each..][..each];
                for ((out, pull), point) in out.iter_mut().zip(&outline.pulls).zip(points) {
                    *out = self.lifted(*point, *pull);
                }
            });
        Ok(out)
    }

    /// How many vertices there are in a frame.
    fn check(&self) -> Result<usize, OpsError> {
        let each = self.points.len() / self.frames.max(1);
        check_length("points", self.frames * each, self.points.len())?;
        match self.faces.as_flattened().iter().max() {
            Some(&last) if last >= each => Err(OpsError::BadSize {
                name: "faces",
                expected: "indices of vertices",
                got: last,
            }),
            _ => Ok(each),
        }
    }

    /// Where a frame's vertices are among the samples, which are at whole numbers; those behind the camera are nowhere.
    fn seen(&self, frame: usize, each: usize) -> Vec<Option<Point>> {
        let rows = self.intrinsics.map(|row| row.map(Real::as_f64));
        self.points[frame * each..][..each]
            .iter()
            .map(|point| {
                let p = point.map(Real::as_f64);
                (p[2] > NEAREST).then(|| {
                    [0, 1].map(|axis| {
                        let row: [f64; 3] = rows[axis];
                        let pixels = (row[0] * p[0] + row[1] * p[1]) / p[2] + row[2];
                        pixels * SAMPLES[axis] as f64 - 0.5
                    })
                })
            })
            .collect()
    }

    /// The gradient in space of one among the samples.
    fn lifted(&self, point: [T; 3], pull: Point) -> [T; 3] {
        let [u, v] = self.intrinsics.map(|row| row.map(Real::as_f64));
        let [x, y, z] = point.map(Real::as_f64);
        let inverse = if z > NEAREST { 1.0 / z } else { 0.0 };
        // Pixels are larger than samples, and each sample is a small part of one.
        let pull = [pull[0] / SAMPLES[1] as f64, pull[1] / SAMPLES[0] as f64];
        let along = [0, 1].map(|axis| (pull[0] * u[axis] + pull[1] * v[axis]) * inverse);
        let deep = -(along[0] * x + along[1] * y) * inverse;
        [T::of(along[0]), T::of(along[1]), T::of(deep)]
    }
}

impl Covered {
    /// The covered share of each pixel, B × H × W.
    ///
    /// # Errors
    /// No memory.
    pub fn shares<T: Real>(&self) -> Result<Vec<T>, OpsError> {
        let [width, height] = self.frames.first().map_or([0, 0], |bits| bits.size);
        let mut out = filled_with("shares", T::ZERO, &[self.frames.len(), height, width])?;
        if !out.is_empty() {
            out.par_chunks_exact_mut(width * height)
                .zip(&self.frames)
                .for_each(|(out, bits)| bits.shares(out));
        }
        Ok(out)
    }
}

//! The share of each pixel that a posed mesh covers, and how it changes with the mesh.
//!
//! What a mesh covers ends at its outline, so only the outline moves a share: where a line of samples ends at an edge, the
//! share changes as the end moves. No surface has to be made soft for a gradient.

use bigs_raster::{Real, filled_with};
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;

/// Samples in a pixel, across and down; those across are the bits of a byte.
const SAMPLES: [usize; 2] = [ACROSS, DOWN];
const ACROSS: usize = 8;
const DOWN: usize = 4;
const PIXELS_IN_WORD: usize = u64::BITS as usize / ACROSS;
/// A place among samples that no picture reaches.
const FAR_OUTSIDE: f64 = 1e9;
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

/// Where a frame's samples are covered: words along each row of samples, the first pixel in the lowest byte.
#[derive(Clone, Debug)]
struct Bits {
    words: Vec<u64>,
    stride: usize,
    size: [usize; 2],
}

/// An edge, and the vertices that make triangles with it.
struct Edge {
    ends: [usize; 2],
    across: Vec<usize>,
}

type Point = [f64; 2];

impl<T: Real> Mesh<'_, T> {
    /// What the mesh covers.
    ///
    /// # Errors
    /// A length that does not fit, a vertex that there is not, a point that is not finite.
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
        let mut frames = Vec::new();
        frames.resize_with(self.frames, || Bits::empty(self.size));
        frames.par_iter_mut().enumerate().for_each(|(frame, bits)| {
            let seen = self.seen(frame, each);
            for face in self.faces {
                if let [Some(a), Some(b), Some(c)] = face.map(|vertex| seen[vertex]) {
                    bits.fill([a, b, c]);
                }
            }
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
        let edges = edges(self.faces);
        (
            out.par_chunks_exact_mut(each),
            &covered.frames,
            v_shares.par_chunks_exact(pixels),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(frame, (out, bits, v))| {
                let seen = self.seen(frame, each);
                let mut outline = Outline::new(bits, v, each);
                for edge in &edges {
                    outline.add(edge, &seen);
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

impl Bits {
    fn empty(size: [usize; 2]) -> Self {
        let stride = size[0].div_ceil(PIXELS_IN_WORD);
        Self {
            words: vec![0; stride * size[1] * DOWN],
            stride,
            size,
        }
    }

    /// Marks the samples inside a triangle.
    fn fill(&mut self, mut corners: [Point; 3]) {
        corners.sort_unstable_by(|a, b| a[1].total_cmp(&b[1]));
        let [top, middle, bottom] = corners;
        let long = Side::new(top, bottom);
        for (from, to) in [(top, middle), (middle, bottom)] {
            self.fill_between(&long, &Side::new(from, to), [from[1], to[1]]);
        }
    }

    /// Marks the samples between two sides, in rows from the first number to before the second one.
    fn fill_between(&mut self, a: &Side, b: &Side, rows: [f64; 2]) {
        let [first, end] = rows.map(|row| ceil_within(row, (self.size[1] * DOWN) as f64));
        let most = (self.size[0] * ACROSS) as f64;
        for row in first..end {
            let (one, other) = (a.at(row as f64), b.at(row as f64));
            let [from, to] = [one.min(other), one.max(other)].map(|x| ceil_within(x, most));
            self.mark(row, from, to);
        }
    }

    /// Marks samples `from` up to `to` of a row.
    fn mark(&mut self, row: usize, from: usize, to: usize) {
        if from >= to {
            return;
        }
        const BITS: usize = u64::BITS as usize;
        let words = &mut self.words[row * self.stride..][..self.stride];
        let (first, last) = (from / BITS, (to - 1) / BITS);
        let head = u64::MAX << (from % BITS);
        let tail = u64::MAX >> (BITS - 1 - (to - 1) % BITS);
        if first == last {
            words[first] |= head & tail;
        } else {
            words[first] |= head;
            words[first + 1..last].fill(u64::MAX);
            words[last] |= tail;
        }
    }

    fn shares<T: Real>(&self, out: &mut [T]) {
        let part = 1.0 / (DOWN * ACROSS) as f64;
        let [width, _] = self.size;
        for (rows, out) in self
            .words
            .chunks_exact(self.stride * DOWN)
            .zip(out.chunks_exact_mut(width))
        {
            for (word, out) in out.chunks_mut(PIXELS_IN_WORD).enumerate() {
                let mut counts = [0_u32; PIXELS_IN_WORD];
                for row in 0..DOWN {
                    let bytes = rows[row * self.stride + word].to_le_bytes();
                    for (count, byte) in counts.iter_mut().zip(bytes) {
                        *count += byte.count_ones();
                    }
                }
                for (out, &count) in out.iter_mut().zip(&counts) {
                    *out = T::of(f64::from(count) * part);
                }
            }
        }
    }

    /// The word and the bit of a sample; none is outside the picture.
    fn place(&self, [column, row]: [i64; 2]) -> Option<(usize, u64)> {
        let column = usize::try_from(column)
            .ok()
            .filter(|&at| at < self.size[0] * ACROSS)?;
        let row = usize::try_from(row).ok().filter(|&at| at < self.size[1] * DOWN)?;
        let word = row * self.stride + column / u64::BITS as usize;
        Some((word, 1 << (column % u64::BITS as usize)))
    }
}

/// The least whole number that is no less than a number, which is first brought to between 0 and `most`.
fn ceil_within(x: f64, most: f64) -> usize {
    // `f64::ceil` is a call where nothing newer than SSE2 may be assumed.
    let x = x.clamp(0.0, most);
    let whole = x as u32;
    (whole + u32::from(f64::from(whole) < x)) as usize
}

/// The line along a side of a triangle.
struct Side {
    start: Point,
    slope: f64,
}

impl Side {
    /// From its upper end to its lower one: both triangles at a side see the same line, and no sample is lost between them.
    fn new(a: Point, b: Point) -> Self {
        Self {
            start: a,
            slope: (b[0] - a[0]) / (b[1] - a[1]),
        }
    }

    fn at(&self, y: f64) -> f64 {
        self.start[0] + (y - self.start[1]) * self.slope
    }
}

/// The edges of triangles, in an order of their own.
fn edges(faces: &[[usize; 3]]) -> Vec<Edge> {
    let mut all: Vec<([usize; 2], usize)> = faces
        .iter()
        .flat_map(|&[a, b, c]| {
            [
                ([a.min(b), a.max(b)], c),
                ([b.min(c), b.max(c)], a),
                ([c.min(a), c.max(a)], b),
            ]
        })
        .collect();
    all.sort_unstable();
    all.chunk_by(|one, other| one.0 == other.0)
        .map(|of_edge| Edge {
            ends: of_edge[0].0,
            across: of_edge.iter().map(|&(_, across)| across).collect(),
        })
        .collect()
}

/// One frame's outline, along which the gradient of the shares pulls at vertices.
struct Outline<'a, T> {
    bits: &'a Bits,
    v: &'a [T],
    /// Of each direction, up, down, left and right, the uncovered samples that an edge already ends at. Several edges may
    /// lie nearer to each other than samples do, of which one moves what is covered.
    taken: [Vec<u64>; 4],
    /// V, in samples.
    pulls: Vec<Point>,
}

impl<'a, T: Real> Outline<'a, T> {
    fn new(bits: &'a Bits, v: &'a [T], vertices: usize) -> Self {
        Self {
            bits,
            v,
            taken: std::array::from_fn(|_| vec![0; bits.words.len()]),
            pulls: vec![[0.0; 2]; vertices],
        }
    }

    /// Adds what an edge does between vertices that are seen, in samples.
    fn add(&mut self, edge: &Edge, seen: &[Option<Point>]) {
        let [Some(a), Some(b)] = edge.ends.map(|end| seen[end]) else {
            return;
        };
        let along = [b[0] - a[0], b[1] - a[1]];
        // What is covered ends here only where all triangles lie on one side.
        let (mut left, mut right) = (false, false);
        for &corner in &edge.across {
            let Some(c) = seen[corner] else { return };
            let turn = along[0] * (c[1] - a[1]) - along[1] * (c[0] - a[0]);
            left |= turn > 0.0;
            right |= turn < 0.0;
        }
        if left == right {
            return;
        }
        let normal = if left {
            [along[1], -along[0]]
        } else {
            [-along[1], along[0]]
        };
        // The axis along which the edge crosses more lines of samples, and the other one, along which it ends them.
        let main = usize::from(along[1].abs() * ACROSS as f64 > along[0].abs() * DOWN as f64);
        let other = 1 - main;
        let onwards = normal[other] > 0.0;
        let slope = along[other] / along[main];
        let most = (self.bits.size[main] * SAMPLES[main]) as f64;
        let (low, high) = (a[main].min(b[main]), a[main].max(b[main]));
        for line in ceil_within(low, most)..ceil_within(high, most) {
            let share = (line as f64 - a[main]) / along[main];
            let end = a[other] + share * along[other];
            if let Some(v) = self.take(main, line, end, onwards) {
                let force = if onwards { v } else { -v };
                for (vertex, part) in edge.ends.into_iter().zip([1.0 - share, share]) {
                    self.pulls[vertex][other] += part * force;
                    self.pulls[vertex][main] -= part * force * slope;
                }
            }
        }
    }

    /// The gradient of the share of the pixel in which a line of samples ends; none where something goes on, where another
    /// edge ends the line, or outside the picture.
    fn take(&mut self, main: usize, line: usize, end: f64, onwards: bool) -> Option<f64> {
        let other = 1 - main;
        let first_outside = end.clamp(-1.0, FAR_OUTSIDE).ceil() as i64 - i64::from(!onwards);
        let sample = |along: i64| {
            if main == 0 {
                [line as i64, along]
            } else {
                [along, line as i64]
            }
        };
        if let Some((word, bit)) = self.bits.place(sample(first_outside)) {
            let taken = &mut self.taken[2 * main + usize::from(onwards)][word];
            if (self.bits.words[word] | *taken) & bit != 0 {
                return None;
            }
            *taken |= bit;
        }
        // Of the samples on both sides of the end, in whose pixel is it?
        let at = (end + 0.5) / SAMPLES[other] as f64;
        if at < 0.0 || at >= self.bits.size[other] as f64 {
            return None;
        }
        let pixel = [line / SAMPLES[main], at as usize];
        Some(self.v[pixel[other] * self.bits.size[0] + pixel[main]].as_f64())
    }
}

//! The edges at which what a mesh covers ends, and how they move it.

use bigs_raster::Real;

use super::bits::{Bits, Point, SAMPLES, ceil_within};

/// A place among samples that no picture reaches.
const FAR_OUTSIDE: f64 = 1e9;

/// An edge, and the vertices that make triangles with it.
pub(super) struct Edge {
    ends: [usize; 2],
    across: Vec<usize>,
}

/// The edges of triangles, in an order of their own.
pub(super) fn edges(faces: &[[usize; 3]]) -> Vec<Edge> {
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
pub(super) struct Outline<'a, T> {
    bits: &'a Bits,
    v: &'a [T],
    /// Of each direction, up, down, left and right, the uncovered samples that an edge already ends at. Several edges may
    /// lie nearer to each other than samples do, of which one moves what is covered.
    taken: [Vec<u64>; 4],
    /// V, in samples.
    pub(super) pulls: Vec<Point>,
}

impl<'a, T: Real> Outline<'a, T> {
    pub(super) fn new(bits: &'a Bits, v: &'a [T], vertices: usize) -> Self {
        Self {
            bits,
            v,
            taken: std::array::from_fn(|_| vec![0; bits.words.len()]),
            pulls: vec![[0.0; 2]; vertices],
        }
    }

    /// Adds what an edge does between vertices that are seen, in samples.
    pub(super) fn add(&mut self, edge: &Edge, seen: &[Option<Point>]) {
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
        let main = usize::from(along[1].abs() * SAMPLES[0] as f64 > along[0].abs() * SAMPLES[1] as f64);
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
        let sample = if main == 0 {
            [line as i64, first_outside]
        } else {
            [first_outside, line as i64]
        };
        if let Some((word, bit)) = self.bits.place(sample) {
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
        let (of_line, of_end) = (line / SAMPLES[main], at as usize);
        let [x, y] = if main == 0 {
            [of_line, of_end]
        } else {
            [of_end, of_line]
        };
        Some(self.v[y * self.bits.size[0] + x].as_f64())
    }
}

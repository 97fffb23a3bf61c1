//! How the edges at which what a mesh covers ends move it.

use bigs_raster::Real;

use super::bits::{Bits, Point, SAMPLES, ceil_within};

/// A place among samples that no picture reaches.
const FAR_OUTSIDE: f64 = 1e9;

/// Of each direction, up, down, left and right, the uncovered samples that an edge already ends at. Several edges may lie
/// nearer to each other than samples do, of which one moves what is covered.
#[derive(Default)]
pub(super) struct Taken {
    words: [Vec<u64>; 4],
    touched: Vec<(usize, usize)>,
}

impl Taken {
    /// None are, of so many words; the memory is used again.
    fn begin(&mut self, words: usize) {
        for (direction, word) in self.touched.drain(..) {
            self.words[direction][word] = 0;
        }
        for direction in &mut self.words {
            direction.resize(words, 0);
        }
    }

    /// Whether a sample was not yet; it is now.
    fn add(&mut self, direction: usize, word: usize, bit: u64) -> bool {
        let taken = &mut self.words[direction][word];
        let new = *taken & bit == 0;
        if *taken == 0 {
            self.touched.push((direction, word));
        }
        *taken |= bit;
        new
    }
}

/// One frame's outline, along which the gradient of the shares pulls at vertices.
pub(super) struct Outline<'a, T> {
    bits: &'a Bits,
    v: &'a [T],
    taken: &'a mut Taken,
    /// V, in samples.
    pub(super) pulls: Vec<Point>,
}

impl<'a, T: Real> Outline<'a, T> {
    pub(super) fn new(bits: &'a Bits, v: &'a [T], vertices: usize, taken: &'a mut Taken) -> Self {
        taken.begin(bits.words.len());
        Self {
            bits,
            v,
            taken,
            pulls: vec![[0.0; 2]; vertices],
        }
    }

    /// Adds what an edge from `a` to `b`, in samples, does to its vertices `ends`, if all triangles lie on one side of it:
    /// 1 for the right as one walks down the picture, -1 for the left.
    pub(super) fn add(&mut self, ends: [usize; 2], [a, b]: [Point; 2], side: i32) {
        let along = [b[0] - a[0], b[1] - a[1]];
        let normal = if side < 0 {
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
                for (vertex, part) in ends.into_iter().zip([1.0 - share, share]) {
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
            let direction = 2 * main + usize::from(onwards);
            if self.bits.words[word] & bit != 0 || !self.taken.add(direction, word, bit) {
                return None;
            }
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

//! Which samples of a picture triangles cover.

use bigs_raster::{Real, filled_with};

use crate::OpsError;

/// Samples in a pixel, across and down; those across are the bits of a byte.
pub(super) const SAMPLES: [usize; 2] = [ACROSS, DOWN];
const ACROSS: usize = 8;
const DOWN: usize = 4;
const PIXELS_IN_WORD: usize = u64::BITS as usize / ACROSS;

/// A place among the samples, which are at whole numbers: across, down.
pub(super) type Point = [f64; 2];

/// Where a frame's samples are covered: words along each row of samples, the first pixel in the lowest byte.
#[derive(Clone, Debug)]
pub(super) struct Bits {
    pub(super) words: Vec<u64>,
    stride: usize,
    pub(super) size: [usize; 2],
}

impl Bits {
    /// # Errors
    /// No memory.
    pub(super) fn empty(size: [usize; 2]) -> Result<Self, OpsError> {
        let stride = size[0].div_ceil(PIXELS_IN_WORD);
        Ok(Self {
            words: filled_with("samples", 0, &[size[1], DOWN, stride])?,
            stride,
            size,
        })
    }

    /// Marks the samples inside a triangle.
    pub(super) fn fill(&mut self, mut corners: [Point; 3]) {
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

    /// The covered share of each pixel, H × W.
    pub(super) fn shares<T: Real>(&self, out: &mut [T]) {
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
    pub(super) fn place(&self, [column, row]: [i64; 2]) -> Option<(usize, u64)> {
        let column = usize::try_from(column)
            .ok()
            .filter(|&at| at < self.size[0] * ACROSS)?;
        let row = usize::try_from(row).ok().filter(|&at| at < self.size[1] * DOWN)?;
        let word = row * self.stride + column / u64::BITS as usize;
        Some((word, 1 << (column % u64::BITS as usize)))
    }
}

/// The least whole number that is no less than a number, which is first brought to between 0 and `most`.
pub(super) fn ceil_within(x: f64, most: f64) -> usize {
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

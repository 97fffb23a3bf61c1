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

/// A sample of a row at which so many triangles more begin than end.
#[derive(Clone, Copy)]
pub(super) struct Crossing {
    row: usize,
    column: usize,
    net: i32,
}

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

    /// Marks the samples that lie in a triangle: those to the left of which more triangles begin than end.
    pub(super) fn fill(&mut self, mut crossings: Vec<Crossing>) {
        crossings.sort_unstable_by_key(|crossing| (crossing.row, crossing.column));
        let mut deep = 0;
        for pair in crossings.windows(2) {
            deep += pair[0].net;
            // Whatever begins in a row ends there.
            if deep != 0 {
                self.mark(pair[0].row, pair[0].column, pair[1].column);
            }
        }
    }

    /// Where an edge crosses the rows of samples, where so many triangles more begin than end at it, `net`, as one walks
    /// down from `a` to `b`.
    pub(super) fn cross(&self, [a, b]: [Point; 2], net: i32, crossings: &mut Vec<Crossing>) {
        // From its upper end to its lower one.
        let ([top, bottom], net) = if a[1] < b[1] {
            ([a, b], net)
        } else {
            ([b, a], -net)
        };
        let slope = (bottom[0] - top[0]) / (bottom[1] - top[1]);
        let [width, height] = [self.size[0] * ACROSS, self.size[1] * DOWN].map(|size| size as f64);
        for row in ceil_within(top[1], height)..ceil_within(bottom[1], height) {
            let x = top[0] + (row as f64 - top[1]) * slope;
            let column = ceil_within(x, width);
            crossings.push(Crossing { row, column, net });
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

    /// The covered share of each pixel, H × W; those that are not covered at all are left as they are.
    pub(super) fn shares<T: Real>(&self, out: &mut [T]) {
        let part = 1.0 / (DOWN * ACROSS) as f64;
        let [width, _] = self.size;
        for (rows, out) in self
            .words
            .chunks_exact(self.stride * DOWN)
            .zip(out.chunks_exact_mut(width))
        {
            for (word, out) in out.chunks_mut(PIXELS_IN_WORD).enumerate() {
                let of_row = |row: usize| rows[row * self.stride + word];
                if (0..DOWN).all(|row| of_row(row) == 0) {
                    continue;
                }
                let counts: u64 = (0..DOWN).map(|row| ones_in_bytes(of_row(row))).sum();
                for (out, count) in out.iter_mut().zip(counts.to_le_bytes()) {
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

/// How many bits are set in each byte of a word; eight counts at once, where `u64::count_ones` may be no instruction.
fn ones_in_bytes(word: u64) -> u64 {
    const EVERY_BYTE: u64 = u64::MAX / 0xff;
    let pairs = word - ((word >> 1) & (0x55 * EVERY_BYTE));
    let fours = (pairs & (0x33 * EVERY_BYTE)) + ((pairs >> 2) & (0x33 * EVERY_BYTE));
    (fours + (fours >> 4)) & (0x0f * EVERY_BYTE)
}

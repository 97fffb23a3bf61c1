//! What was seen where.

use std::ops::Range;

use crate::TrackError;
use crate::bundle::band::Bands;

/// Least observations of a piece, and least for each frame, since each piece has a sum of its own for every frame.
const PIECE: usize = 2048;
const PIECE_PER_FRAME: usize = 32;

/// A frame that may not move.
pub(crate) const STILL: u32 = u32::MAX;

/// Observations of P points in T frames, by point and then by frame, of which F may move.
#[derive(Clone, Debug)]
pub struct Sightings {
    /// Frame of each observation.
    pub(crate) frame: Vec<u32>,
    pub(crate) pixels: Vec<[f64; 2]>,
    /// Inverse covariances (xx, xy, yy) in units of 1 / sigma².
    pub(crate) precision: Vec<[f64; 3]>,
    /// P + 1: where each point's observations begin.
    pub(crate) starts: Vec<usize>,
    /// T: which of the moving frames each is, or [`STILL`].
    pub(crate) slots: Vec<u32>,
    pub(crate) moving: usize,
    /// Points of each piece of work.
    pub(crate) pieces: Vec<Range<usize>>,
    pub(crate) bands: Bands,
}

impl Sightings {
    /// Observations one by one: their frame, the rank of their point, pixels and precision; and of each frame whether
    /// it may move. A frame may have seen a point twice.
    ///
    /// # Errors
    ///
    /// Lengths that differ, a frame that there is not, or observations that are not in order of ranks without a gap
    /// and within a point in order of frames.
    pub fn new(
        frame: &[i64],
        point: &[i64],
        pixels: Vec<[f64; 2]>,
        precision: Vec<[f64; 3]>,
        free: &[bool],
    ) -> Result<Self, TrackError> {
        for (what, found) in [
            ("point", point.len()),
            ("pixels", pixels.len()),
            ("precision", precision.len()),
        ] {
            TrackError::check_length(what, frame.len(), found)?;
        }
        // Indices are kept as 32 bits, the last of which says something else.
        let most = frame.len().max(free.len());
        if most >= STILL as usize {
            return Err(TrackError::index(
                "frame",
                "fewer than 2^32 - 1 of them",
                most as i64,
            ));
        }
        let mut starts = vec![];
        for (row, (&own, &rank)) in frame.iter().zip(point).enumerate() {
            if own < 0 || own as usize >= free.len() {
                return Err(TrackError::index(
                    "frame",
                    &format!("0 to {}", free.len() as i64 - 1),
                    own,
                ));
            }
            let next = starts.len() as i64;
            if rank == next {
                starts.push(row);
            } else if next == 0 || rank != next - 1 {
                return Err(TrackError::index(
                    "point",
                    &format!("ranks in order, here {next} at most"),
                    rank,
                ));
            } else if frame[row - 1] > own {
                return Err(TrackError::index(
                    "frame",
                    &format!("a point's in order, here {} or more", frame[row - 1]),
                    own,
                ));
            }
        }
        starts.push(frame.len());
        let mut moving = 0;
        let slots: Vec<u32> = free
            .iter()
            .map(|&free| {
                moving += u32::from(free);
                if free { moving - 1 } else { STILL }
            })
            .collect();
        let moving = moving as usize;
        let frame: Vec<u32> = frame.iter().map(|&own| own as u32).collect();
        let bands = Bands::new(&starts, &frame, &slots, moving);
        Ok(Self {
            pieces: pieces(&starts, PIECE.max(PIECE_PER_FRAME * moving)),
            frame,
            pixels,
            precision,
            starts,
            slots,
            moving,
            bands,
        })
    }

    /// T.
    pub fn frames(&self) -> usize {
        self.slots.len()
    }

    /// F.
    pub fn moving(&self) -> usize {
        self.moving
    }

    /// P.
    pub fn points(&self) -> usize {
        self.starts.len() - 1
    }

    /// Number of observations.
    pub fn count(&self) -> usize {
        self.frame.len()
    }

    /// The observations of some points.
    pub(crate) fn rows(&self, points: &Range<usize>) -> Range<usize> {
        self.starts[points.start]..self.starts[points.end]
    }

    /// Values of all points, in pieces.
    pub(crate) fn by_piece<'a, T>(&self, values: &'a mut [T]) -> Vec<&'a mut [T]> {
        cut(values, self.pieces.iter().map(Range::len))
    }

    /// Values of all observations, in pieces.
    pub(crate) fn rows_by_piece<'a, T>(&self, values: &'a mut [T]) -> Vec<&'a mut [T]> {
        cut(values, self.pieces.iter().map(|piece| self.rows(piece).len()))
    }
}

/// Consecutive points with at least so many observations, but for the last ones.
fn pieces(starts: &[usize], least: usize) -> Vec<Range<usize>> {
    let points = starts.len() - 1;
    let mut pieces = vec![];
    let mut first = 0;
    for point in 0..points {
        if starts[point + 1] - starts[first] >= least || point + 1 == points {
            pieces.push(first..point + 1);
            first = point + 1;
        }
    }
    pieces
}

/// Values in parts of these lengths.
fn cut<T>(mut values: &mut [T], lengths: impl Iterator<Item = usize>) -> Vec<&mut [T]> {
    lengths
        .map(|length| values.split_off_mut(..length).unwrap_or_default())
        .collect()
}

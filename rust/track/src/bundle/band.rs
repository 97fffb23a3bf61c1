//! Frames that may move, four by four, and what each four saw.

use std::ops::Range;

use crate::bundle::sightings::STILL;

/// Frames of a band, and the unknowns that they have.
pub(crate) const FRAMES: usize = 4;
pub(crate) const UNKNOWNS: usize = 6 * FRAMES;

/// A round is as many points as have this many blocks, which the cache holds, and for each band so many, since a round
/// adds to all pairs of bands.
const BLOCKS: usize = 2048;
const BLOCKS_PER_BAND: usize = 64;

/// A point that a band saw.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    pub(crate) point: u32,
    /// First and last plus one of its observations in the band, frames in between that may not move included.
    pub(crate) rows: [u32; 2],
    /// One bit for each frame of the band that saw it.
    pub(crate) by: u8,
}

/// All bands, and rounds in which their points are eliminated.
#[derive(Clone, Debug)]
pub(crate) struct Bands {
    /// Of each band, by point.
    seen: Vec<Vec<Seen>>,
    /// Of each round and band which of these.
    rounds: Vec<Vec<Range<usize>>>,
}

impl Bands {
    /// From observations by point and frame, and the slots of frames, of which there are `moving`.
    pub(crate) fn new(starts: &[usize], frame: &[u32], slots: &[u32], moving: usize) -> Self {
        let mut seen: Vec<Vec<Seen>> = vec![vec![]; moving.div_ceil(FRAMES)];
        let mut rounds = vec![];
        let mut ends: Vec<usize> = vec![0; seen.len()];
        let most = BLOCKS.max(BLOCKS_PER_BAND * seen.len());
        let mut blocks = 0;
        for point in 0..starts.len() - 1 {
            for row in starts[point]..starts[point + 1] {
                let slot = slots[frame[row] as usize];
                if slot == STILL {
                    continue;
                }
                let band = &mut seen[slot as usize / FRAMES];
                let by = 1 << (slot as usize % FRAMES);
                match band.last_mut() {
                    Some(last) if last.point == point as u32 => {
                        last.rows[1] = row as u32 + 1;
                        last.by |= by;
                    }
                    _ => {
                        band.push(Seen {
                            point: point as u32,
                            rows: [row as u32, row as u32 + 1],
                            by,
                        });
                        blocks += 1;
                    }
                }
            }
            if blocks >= most || point + 2 == starts.len() {
                rounds.push(
                    seen.iter()
                        .zip(&mut ends)
                        .map(|(band, end)| std::mem::replace(end, band.len())..band.len())
                        .collect(),
                );
                blocks = 0;
            }
        }
        Self { seen, rounds }
    }

    pub(crate) fn count(&self) -> usize {
        self.seen.len()
    }

    /// What each band saw, round by round.
    pub(crate) fn rounds(&self) -> impl Iterator<Item = Vec<&[Seen]>> {
        self.rounds.iter().map(|ranges| {
            self.seen
                .iter()
                .zip(ranges)
                .map(|(band, range)| &band[range.clone()])
                .collect()
        })
    }
}

//! What two bands see of the same points, multiplied at the speed of the CPU's vectors.

use bigs_raster::{Simd, SimdLevel, Vector, Work};

use crate::bundle::band::{FRAMES, Seen, UNKNOWNS};

/// Pairs of blocks that are multiplied while they stay in the nearest cache.
const TOGETHER: usize = 32;

/// A band's coupling with a point, scaled: for each of three numbers of the point the band's unknowns.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(crate) struct Block(pub(crate) [[f64; UNKNOWNS]; 3]);

pub(crate) const EMPTY: Block = Block([[0.0; UNKNOWNS]; 3]);

/// What a band saw of a round's points.
#[derive(Clone, Copy)]
pub(crate) struct Panel<'a> {
    pub(crate) seen: &'a [Seen],
    /// As many.
    pub(crate) blocks: &'a [Block],
}

/// Sums of products of the unknowns of two bands; a row for each unknown of the first.
#[derive(Clone, Debug)]
pub(crate) struct Tile(pub(crate) [[f64; UNKNOWNS]; UNKNOWNS]);

/// Space for pairs of blocks, kept from tile to tile.
#[derive(Default)]
pub(crate) struct Pairs {
    all: Vec<[u32; 2]>,
    own: Vec<[u32; 2]>,
}

impl Tile {
    pub(crate) fn zero() -> Self {
        Self([[0.0; UNKNOWNS]; UNKNOWNS])
    }

    /// Add the products of blocks of the same points, in order of these.
    pub(crate) fn add(&mut self, level: SimdLevel, first: Panel<'_>, second: Panel<'_>, pairs: &mut Pairs) {
        meet(first.seen, second.seen, &mut pairs.all);
        level.run(Products {
            tile: self,
            first,
            second,
            pairs,
        });
    }
}

/// Where two bands saw the same points.
fn meet(first: &[Seen], second: &[Seen], pairs: &mut Vec<[u32; 2]>) {
    pairs.clear();
    pairs.resize(first.len().min(second.len()), [0; 2]);
    let (mut i, mut j, mut count) = (0, 0, 0);
    // Without branches, which nobody could foretell: a pair is kept by stepping past it.
    while i < first.len() && j < second.len() {
        let (a, b) = (first[i].point, second[j].point);
        // Beyond the last pair one of the bands has ended.
        pairs[count] = [i as u32, j as u32];
        count += usize::from(a == b);
        i += usize::from(a <= b);
        j += usize::from(b <= a);
        if count == pairs.len() {
            break;
        }
    }
    pairs.truncate(count);
}

struct Products<'a> {
    tile: &'a mut Tile,
    first: Panel<'a>,
    second: Panel<'a>,
    pairs: &'a mut Pairs,
}

impl Work for Products<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Pairs { all, own } = self.pairs;
        for all in all.chunks(TOGETHER) {
            for frame in 0..FRAMES {
                own.clear();
                own.extend(
                    all.iter()
                        .filter(|pair| self.first.seen[pair[0] as usize].by >> frame & 1 == 1),
                );
                let (first, second) = (self.first.blocks, self.second.blocks);
                if own.is_empty() {
                    continue;
                }
                let rows = &mut self.tile.0.as_chunks_mut::<6>().0[frame];
                // As many sums as the level has room for, beside what is multiplied.
                if <S::F64 as Vector>::LANES == 8 {
                    add_products::<S, 3>(simd, rows, frame, first, second, own);
                } else {
                    add_products::<S, 2>(simd, rows, frame, first, second, own);
                }
            }
        }
    }
}

/// Add the products of a frame's six unknowns and all of the second band, N vectors of these at a time.
#[inline(always)]
fn add_products<S: Simd, const N: usize>(
    simd: S,
    rows: &mut [[f64; UNKNOWNS]; 6],
    frame: usize,
    first: &[Block],
    second: &[Block],
    pairs: &[[u32; 2]],
) {
    let lanes = <S::F64 as Vector>::LANES;
    for at in (0..UNKNOWNS).step_by(N * lanes) {
        let mut sums = [[S::F64::splat(simd, 0.0); N]; 6];
        for &[a, b] in pairs {
            let (a, b) = (&first[a as usize].0, &second[b as usize].0);
            for k in 0..3 {
                let own = &a[k].as_chunks::<6>().0[frame];
                let mut other = [sums[0][0]; N];
                for n in 0..N {
                    other[n] = S::F64::load(simd, &b[k][at + n * lanes..]);
                }
                for i in 0..6 {
                    let value = S::F64::splat(simd, own[i]);
                    for n in 0..N {
                        sums[i][n] = value.times_plus(other[n], sums[i][n]);
                    }
                }
            }
        }
        for i in 0..6 {
            for n in 0..N {
                let row = &mut rows[i][at + n * lanes..];
                S::F64::load(simd, row).plus(sums[i][n]).store(row);
            }
        }
    }
}

//! The points eliminated from the normal equations.
//!
//! A point that F frames see couples all of them: its part of the poses' equations has 36 F² numbers. Points are taken
//! in rounds that fit into the cache. Within a round each band of frames has a dense block for every point that it saw,
//! and each pair of bands multiplies the blocks of the points that both saw.

use bigs_raster::{Simd, SimdLevel, Work};
use rayon::prelude::*;

use crate::TrackError;
use crate::bundle::Sightings;
use crate::bundle::band::{FRAMES, Seen, UNKNOWNS};
use crate::bundle::glance::cross;
use crate::bundle::linearise::Coupling;
use crate::bundle::points::Inverse;
use crate::bundle::sightings::STILL;
use crate::bundle::tile::{Block, EMPTY, Pairs, Panel, Tile};

/// Normal equations as [`Sightings::linearise`] makes them, perhaps with more added to those of the poses.
#[derive(Clone, Copy, Debug)]
pub struct Equations<'a> {
    /// 6F × 6F, symmetric.
    pub poses: &'a [f64],
    /// 6F.
    pub pose_gradient: &'a [f64],
    /// P, row by row.
    pub points: &'a [[f64; 9]],
    /// P.
    pub point_gradient: &'a [[f64; 3]],
    /// One for each observation.
    pub couplings: &'a [[f64; 12]],
}

/// The poses' equations without the points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reduced {
    /// 6F × 6F.
    pub matrix: Vec<f64>,
    /// 6F.
    pub gradient: Vec<f64>,
    /// P, row by row: inverses of the points' damped matrices. One that has none is 0.
    pub inverses: Vec<[f64; 9]>,
}

impl Sightings {
    /// Eliminate the points, after Levenberg's and Marquardt's `damping` of all equations.
    ///
    /// # Errors
    ///
    /// Equations of another number of unknowns or observations, or a level of vectors that this machine does not have.
    pub fn reduce(&self, equations: &Equations<'_>, damping: f64) -> Result<Reduced, TrackError> {
        let unknowns = 6 * self.moving;
        for (what, expected, found) in [
            ("poses", unknowns * unknowns, equations.poses.len()),
            ("pose_gradient", unknowns, equations.pose_gradient.len()),
            ("points", self.points(), equations.points.len()),
            ("point_gradient", self.points(), equations.point_gradient.len()),
            ("couplings", self.count(), equations.couplings.len()),
        ] {
            TrackError::check_length(what, expected, found)?;
        }
        let level = SimdLevel::chosen().map_err(|error| TrackError::level(&error))?;
        let inverses: Vec<Inverse> = equations
            .points
            .par_iter()
            .map(|matrix| Inverse::damped(matrix, damping))
            .collect();
        let held: Vec<[f64; 3]> = inverses
            .par_iter()
            .zip(equations.point_gradient)
            .map(|(inverse, gradient)| inverse.root_times(*gradient))
            .collect();
        let eliminated = self.eliminated(level, equations.couplings, &inverses, &held);
        let mut reduced = Reduced {
            matrix: vec![0.0; unknowns * unknowns],
            gradient: equations.pose_gradient.to_vec(),
            inverses: inverses.par_iter().map(|inverse| inverse.whole).collect(),
        };
        for (value, own) in reduced
            .gradient
            .iter_mut()
            .zip(eliminated.gradient.as_flattened())
        {
            *value -= own;
        }
        let width = unknowns.max(1);
        reduced
            .matrix
            .par_chunks_exact_mut(width)
            .zip(equations.poses.par_chunks_exact(width))
            .enumerate()
            .for_each(|(i, (row, own))| {
                row.copy_from_slice(own);
                row[i] = own[i] * (1.0 + damping) + 1e-9;
                eliminated.take_from(i, row);
            });
        Ok(reduced)
    }

    /// What the points' share of the poses' equations is, given inverses, and their roots times the gradient.
    fn eliminated(
        &self,
        level: SimdLevel,
        couplings: &[Coupling],
        inverses: &[Inverse],
        held: &[[f64; 3]],
    ) -> Eliminated {
        let bands = self.bands.count();
        let mut gradient = vec![[0.0; UNKNOWNS]; bands];
        let mut blocks: Vec<Vec<Block>> = vec![vec![]; bands];
        // Later bands by earlier ones, and themselves.
        let mut tiles: Vec<(usize, usize, Tile)> = (0..bands)
            .flat_map(|i| (0..=i).map(move |j| (i, j, Tile::zero())))
            .collect();
        for round in self.bands.rounds() {
            (&mut blocks, &mut gradient, &round)
                .into_par_iter()
                .for_each(|(blocks, gradient, &round)| {
                    blocks.resize(round.len(), EMPTY);
                    level.run(Scaling {
                        seen: self,
                        round,
                        couplings,
                        inverses,
                        held,
                        blocks,
                        gradient,
                    });
                });
            tiles
                .par_iter_mut()
                .for_each_init(Pairs::default, |pairs, (i, j, tile)| {
                    tile.add(
                        level,
                        panel(&round, &blocks, *i),
                        panel(&round, &blocks, *j),
                        pairs,
                    );
                });
        }
        Eliminated {
            tiles: tiles.into_iter().map(|(_, _, tile)| tile).collect(),
            gradient,
        }
    }
}

fn panel<'a>(round: &[&'a [Seen]], blocks: &'a [Vec<Block>], band: usize) -> Panel<'a> {
    Panel {
        seen: round[band],
        blocks: &blocks[band],
    }
}

/// A band's blocks of a round, and what is taken from the gradient of its poses.
struct Scaling<'a> {
    seen: &'a Sightings,
    round: &'a [Seen],
    couplings: &'a [Coupling],
    inverses: &'a [Inverse],
    held: &'a [[f64; 3]],
    blocks: &'a mut [Block],
    gradient: &'a mut [f64; UNKNOWNS],
}

impl Work for Scaling<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for (own, block) in self.round.iter().zip(self.blocks) {
            let (point, rows) = (own.point as usize, own.rows.map(|row| row as usize));
            *block = EMPTY;
            for row in rows[0]..rows[1] {
                let slot = self.seen.slots[self.seen.frame[row] as usize];
                if slot != STILL {
                    let at = 6 * (slot as usize % FRAMES);
                    block.add(&self.couplings[row], &self.inverses[point].root, at);
                }
            }
            for (row, held) in block.0.iter().zip(self.held[point]) {
                for (sum, value) in self.gradient.iter_mut().zip(row) {
                    *sum += value * held;
                }
            }
        }
    }
}

impl Block {
    /// Add a coupling times the transposed root of the point's inverse, for the pose whose unknowns begin at `at`.
    #[inline(always)]
    fn add(&mut self, coupling: &Coupling, [a, b, c, d, e, f]: &[f64; 6], at: usize) {
        let &[ax, ay, az, ref rows @ ..] = coupling;
        let mut scaled = [[0.0; 3]; 3];
        for i in 0..3 {
            let [x, y, z] = [rows[3 * i], rows[3 * i + 1], rows[3 * i + 2]];
            scaled[0][i] = a * x;
            scaled[1][i] = b * x + c * y;
            scaled[2][i] = d * x + e * y + f * z;
        }
        for (row, shift) in self.0.iter_mut().zip(scaled) {
            let turn = cross([ax, ay, az], shift);
            let own = &mut row[at..at + 6];
            for i in 0..3 {
                own[i] += turn[i];
                own[3 + i] += shift[i];
            }
        }
    }
}

/// What elimination takes from the poses' equations, by bands.
struct Eliminated {
    /// Those of band i and j ≤ i, i by i.
    tiles: Vec<Tile>,
    gradient: Vec<[f64; UNKNOWNS]>,
}

impl Eliminated {
    /// Take row i from an equation.
    fn take_from(&self, i: usize, row: &mut [f64]) {
        let (band, i) = (i / UNKNOWNS, i % UNKNOWNS);
        let tile = |band: usize, other: usize| &self.tiles[band * (band + 1) / 2 + other].0;
        for (other, values) in row.chunks_mut(UNKNOWNS).enumerate() {
            if other <= band {
                for (value, own) in values.iter_mut().zip(&tile(band, other)[i]) {
                    *value -= own;
                }
            } else {
                for (value, column) in values.iter_mut().zip(tile(other, band)) {
                    *value -= column[i];
                }
            }
        }
    }
}

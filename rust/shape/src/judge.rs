//! How well symmetries agree with what was seen.

use rayon::prelude::*;

use crate::nearest::Nearest;
use crate::symmetry::{dot, times};
use crate::{Kind, ShapeError, Symmetry, Vec3};

/// Samples that are carried at a time.
const PIECE: usize = 256;

/// Samples of a surface.
#[derive(Clone, Debug)]
pub struct Samples {
    /// Their places.
    pub points: Vec<Vec3>,
    /// Unit, outward.
    pub normals: Vec<Vec3>,
    /// Any three numbers.
    pub colors: Vec<Vec3>,
}

/// Where there is no object: above one half of what a grid says. Beyond the grid is nothing.
#[derive(Clone, Debug)]
pub struct Empty {
    /// X × Y × Z, the last axis fastest.
    pub values: Vec<f64>,
    /// Values along each axis.
    pub size: [usize; 3],
    /// Place of the first value.
    pub origin: Vec3,
    /// Between neighbours.
    pub spacing: f64,
}

/// What speaks for a symmetry and against it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Agreement {
    /// Share of what is carried that meets surface of its kind.
    pub support: f64,
    /// Share that falls where there is nothing.
    pub contradiction: f64,
    /// Mean difference of the colours that meet; NaN where none do.
    pub color_error: f64,
}

/// Judges symmetries of a surface.
#[derive(Clone, Debug)]
pub struct Judge {
    pub(crate) samples: Samples,
    empty: Empty,
    tree: Nearest,
    /// A carried sample meets another that is nearer than this, ...
    pub reach: f64,
    /// ... if the cosine between their normals is above this.
    pub least_cosine: f64,
    /// An axis is judged by turns of this share of the circle, ...
    pub turns: usize,
    /// ... and by every so many samples.
    pub every: usize,
}

/// Sums over some samples.
#[derive(Clone, Copy, Default)]
struct Sums {
    met: u32,
    against: u32,
    error: f64,
}

impl Empty {
    fn at(&self, point: Vec3) -> bool {
        let (mut first, mut share) = ([0; 3], [0.0; 3]);
        for i in 0..3 {
            let place = (point[i] - self.origin[i]) / self.spacing;
            if !(place >= 0.0 && place <= (self.size[i] - 1) as f64) {
                return true;
            }
            first[i] = (place as usize).min(self.size[i].saturating_sub(2));
            share[i] = place - first[i] as f64;
        }
        let mut sum = 0.0;
        for corner in 0..8 {
            let (mut weight, mut index) = (1.0, 0);
            for i in 0..3 {
                let upper = corner >> i & 1;
                weight *= if upper == 1 { share[i] } else { 1.0 - share[i] };
                index = index * self.size[i] + (first[i] + upper).min(self.size[i] - 1);
            }
            sum += weight * self.values[index];
        }
        sum > 0.5
    }
}

impl Judge {
    /// # Errors
    /// Arrays of different lengths, or a grid without values.
    pub fn new(
        samples: Samples,
        empty: Empty,
        (reach, least_cosine): (f64, f64),
        (turns, every): (usize, usize),
    ) -> Result<Self, ShapeError> {
        ShapeError::check("normals", samples.points.len(), samples.normals.len())?;
        ShapeError::check("colors", samples.points.len(), samples.colors.len())?;
        ShapeError::check("empty", empty.size.iter().product(), empty.values.len())?;
        if empty.values.is_empty() {
            return Err(ShapeError::none("empty"));
        }
        Ok(Self {
            tree: Nearest::new(&samples.points),
            samples,
            empty,
            reach,
            least_cosine,
            turns,
            every: every.max(1),
        })
    }

    /// Agreement of each symmetry.
    #[must_use]
    pub fn agreement(&self, symmetries: &[Symmetry]) -> Vec<Agreement> {
        symmetries.par_iter().map(|symmetry| self.of(symmetry)).collect()
    }

    fn of(&self, symmetry: &Symmetry) -> Agreement {
        let matrices = symmetry.matrices(self.turns);
        let carried: Vec<usize> = self.carries(symmetry.kind).collect();
        let pieces: Vec<Sums> = carried
            .par_chunks(PIECE)
            .map(|piece| {
                let mut sums = Sums::default();
                for matrix in &matrices {
                    for &index in piece {
                        self.carry(symmetry, matrix, index, &mut sums);
                    }
                }
                sums
            })
            .collect();
        let all = pieces.iter().fold(Sums::default(), |all, some| Sums {
            met: all.met + some.met,
            against: all.against + some.against,
            error: all.error + some.error,
        });
        let count = (matrices.len() * carried.len()).max(1) as f64;
        Agreement {
            support: f64::from(all.met) / count,
            contradiction: f64::from(all.against) / count,
            color_error: all.error / f64::from(all.met),
        }
    }

    /// Indices of the samples that are carried.
    pub(crate) fn carries(&self, kind: Kind) -> impl Iterator<Item = usize> {
        let every = if kind == Kind::Axis { self.every } else { 1 };
        (0..self.samples.points.len()).step_by(every)
    }

    /// The sample that a carried one meets.
    pub(crate) fn meets(&self, place: Vec3, normal: Vec3, reach: f64) -> Option<usize> {
        let met = self.tree.within(place, reach)?;
        (dot(normal, self.samples.normals[met]) > self.least_cosine).then_some(met)
    }

    fn carry(&self, symmetry: &Symmetry, matrix: &[Vec3; 3], index: usize, sums: &mut Sums) {
        let place = symmetry.carried(matrix, self.samples.points[index]);
        let normal = times(matrix, self.samples.normals[index]);
        if let Some(met) = self.meets(place, normal, self.reach) {
            let (own, there) = (self.samples.colors[index], self.samples.colors[met]);
            sums.met += 1;
            sums.error += (0..3).map(|i| (own[i] - there[i]).abs()).sum::<f64>() / 3.0;
        } else {
            sums.against += u32::from(self.empty.at(place));
        }
    }
}

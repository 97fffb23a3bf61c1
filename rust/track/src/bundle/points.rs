//! Points by themselves: their equations inverted, and what they and the poses do to each other.

use rayon::prelude::*;

use crate::TrackError;
use crate::bundle::Sightings;
use crate::bundle::glance::cross;
use crate::bundle::linearise::Coupling;
use crate::bundle::sightings::STILL;

/// A point's damped equations, inverted. Where they are singular or no numbers, all is 0: the point keeps its place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Inverse {
    /// Lower triangle (00, 10, 11, 20, 21, 22) of the inverse of the matrix' Cholesky factor.
    pub(crate) root: [f64; 6],
    pub(crate) whole: [f64; 9],
}

impl Inverse {
    /// Of a symmetric matrix, after Levenberg's and Marquardt's damping.
    pub(crate) fn damped(matrix: &[f64; 9], damping: f64) -> Self {
        let mut matrix = *matrix;
        for i in [0, 4, 8] {
            matrix[i] *= 1.0 + damping;
        }
        let least = 1e-9 * (1.0 + matrix[0] + matrix[4] + matrix[8]);
        let [m00, m10, m11, m20, m21, m22] = [
            matrix[0] + least,
            matrix[3],
            matrix[4] + least,
            matrix[6],
            matrix[7],
            matrix[8] + least,
        ];
        // matrix = factor factorᵀ; `a`, `c` and `f` are 1 / its diagonal.
        let a = 1.0 / m00.sqrt();
        let (l10, l20) = (m10 * a, m20 * a);
        let c = 1.0 / (m11 - l10 * l10).sqrt();
        let l21 = (m21 - l20 * l10) * c;
        let f = 1.0 / (m22 - l20 * l20 - l21 * l21).sqrt();
        let b = -l10 * a * c;
        let e = -l21 * c * f;
        let d = -(l20 * a + l21 * b) * f;
        let root = [a, b, c, d, e, f];
        if !root.iter().all(|value| value.is_finite()) {
            return Self {
                root: [0.0; 6],
                whole: [0.0; 9],
            };
        }
        let (i00, i10, i20) = (a * a + b * b + d * d, b * c + d * e, d * f);
        let (i11, i21, i22) = (c * c + e * e, e * f, f * f);
        Self {
            root,
            whole: [i00, i10, i20, i10, i11, i21, i20, i21, i22],
        }
    }

    /// Product of the root and a vector.
    pub(crate) fn root_times(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        let [a, b, c, d, e, f] = self.root;
        [a * x, b * x + c * y, d * x + e * y + f * z]
    }
}

/// Product of a matrix and a vector.
fn times(matrix: &[f64; 9], [x, y, z]: [f64; 3]) -> [f64; 3] {
    [0, 3, 6].map(|row| matrix[row] * x + matrix[row + 1] * y + matrix[row + 2] * z)
}

/// What a coupling makes of a point's vector in the pose's equations: turn, then shift.
#[inline(always)]
fn onto_pose(coupling: &Coupling, [x, y, z]: [f64; 3]) -> [f64; 6] {
    let &[ax, ay, az, ref rows @ ..] = coupling;
    let shift = [0, 3, 6].map(|row| rows[row] * x + rows[row + 1] * y + rows[row + 2] * z);
    let turn = cross([ax, ay, az], shift);
    [turn[0], turn[1], turn[2], shift[0], shift[1], shift[2]]
}

/// What a coupling makes of a pose's step in the point's equations.
#[inline(always)]
fn onto_point(coupling: &Coupling, step: &[f64; 6]) -> [f64; 3] {
    let &[ax, ay, az, ref rows @ ..] = coupling;
    let &[tx, ty, tz, x, y, z] = step;
    // By how much the step moves the place.
    let turned = cross([tx, ty, tz], [ax, ay, az]);
    let moved = [x + turned[0], y + turned[1], z + turned[2]];
    std::array::from_fn(|j| rows[j] * moved[0] + rows[3 + j] * moved[1] + rows[6 + j] * moved[2])
}

impl Sightings {
    /// How far every point goes when the poses go by `change`: one row for each frame that may move.
    ///
    /// # Errors
    ///
    /// Arrays of another number of observations, points or moving frames.
    pub fn point_steps(
        &self,
        couplings: &[Coupling],
        gradient: &[[f64; 3]],
        inverses: &[[f64; 9]],
        change: &[[f64; 6]],
    ) -> Result<Vec<[f64; 3]>, TrackError> {
        TrackError::check_length("couplings", self.count(), couplings.len())?;
        TrackError::check_length("gradient", self.points(), gradient.len())?;
        TrackError::check_length("inverses", self.points(), inverses.len())?;
        TrackError::check_length("change", self.moving, change.len())?;
        let mut steps = vec![[0.0; 3]; self.points()];
        (self.pieces.par_iter(), self.by_piece(&mut steps))
            .into_par_iter()
            .for_each(|(piece, steps)| {
                for (point, step) in piece.clone().zip(steps) {
                    let mut pull = gradient[point];
                    for row in self.starts[point]..self.starts[point + 1] {
                        let slot = self.slots[self.frame[row] as usize];
                        if slot != STILL {
                            let own = onto_point(&couplings[row], &change[slot as usize]);
                            pull = std::array::from_fn(|i| pull[i] + own[i]);
                        }
                    }
                    *step = times(&inverses[point], pull).map(|value| -value);
                }
            });
        Ok(steps)
    }

    /// What values of the points do in the equations of the poses, 6F: the sum over observations of coupling times value.
    ///
    /// # Errors
    ///
    /// Arrays of another number of observations or points.
    pub fn carried(&self, couplings: &[Coupling], values: &[[f64; 3]]) -> Result<Vec<f64>, TrackError> {
        TrackError::check_length("couplings", self.count(), couplings.len())?;
        TrackError::check_length("values", self.points(), values.len())?;
        let parts: Vec<Vec<[f64; 6]>> = self
            .pieces
            .par_iter()
            .map(|piece| {
                let mut sums = vec![[0.0; 6]; self.moving];
                for point in piece.clone() {
                    for row in self.starts[point]..self.starts[point + 1] {
                        let slot = self.slots[self.frame[row] as usize];
                        if slot != STILL {
                            let own = onto_pose(&couplings[row], values[point]);
                            let sum = &mut sums[slot as usize];
                            *sum = std::array::from_fn(|i| sum[i] + own[i]);
                        }
                    }
                }
                sums
            })
            .collect();
        let mut total = vec![0.0; 6 * self.moving];
        for part in &parts {
            for (sum, part) in total.iter_mut().zip(part.as_flattened()) {
                *sum += part;
            }
        }
        Ok(total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_root_times_itself_is_the_inverse_and_that_times_the_matrix_is_one() {
        let mut rng = fastrand::Rng::with_seed(3);
        for _ in 0..50 {
            let rows: [[f64; 3]; 4] = std::array::from_fn(|_| std::array::from_fn(|_| rng.f64() - 0.5));
            let matrix: [f64; 9] =
                std::array::from_fn(|at| rows.iter().map(|row| row[at / 3] * row[at % 3]).sum());
            let found = Inverse::damped(&matrix, 0.1);
            let [a, b, c, d, e, f] = found.root;
            let root = [a, 0.0, 0.0, b, c, 0.0, d, e, f];
            let trace = 1.1 * (matrix[0] + matrix[4] + matrix[8]);
            for i in 0..3 {
                for j in 0..3 {
                    let square: f64 = (0..3).map(|k| root[3 * k + i] * root[3 * k + j]).sum();
                    assert!((square - found.whole[3 * i + j]).abs() < 1e-12 * found.whole[0].max(square));
                    let damped = |k: usize| {
                        let own = matrix[3 * k + j];
                        if k == j {
                            1.1 * own + 1e-9 * (1.0 + trace)
                        } else {
                            own
                        }
                    };
                    let one: f64 = (0..3).map(|k| found.whole[3 * i + k] * damped(k)).sum();
                    assert!((one - f64::from(u8::from(i == j))).abs() < 1e-9);
                }
            }
        }
    }

    #[test]
    fn equations_that_have_no_solution_leave_a_point_where_it_is() {
        let mut bent = [1.0, 0.0, 0.0, 0.0, -2.0, 0.0, 0.0, 0.0, 1.0];
        assert_eq!(Inverse::damped(&bent, 0.0).whole, [0.0; 9]);
        for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            bent[4] = odd;
            assert_eq!(Inverse::damped(&bent, 0.0).root, [0.0; 6]);
        }
        let nothing = Inverse::damped(&[0.0; 9], 0.0);
        assert!(nothing.whole.iter().all(|value| value.is_finite()) && nothing.whole[0] > 0.0);
    }
}

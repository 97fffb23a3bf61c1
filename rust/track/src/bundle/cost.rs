//! The sum of Cauchy's losses.

use rayon::prelude::*;

use crate::TrackError;
use crate::bundle::{Scene, Sightings};

/// Losses whose logarithms are taken together, and the largest squares that are: their product must be a number.
const TOGETHER: usize = 4;
const LARGEST: f64 = 1e60;

impl Sightings {
    /// The sum of Cauchy's losses of all reprojection errors.
    ///
    /// # Errors
    ///
    /// A scene of another number of frames or points.
    pub fn cost(&self, scene: &Scene<'_>) -> Result<f64, TrackError> {
        scene.check(self)?;
        let per_square = 1.0 / (scene.sigma * scene.sigma);
        let sums: Vec<f64> = self
            .pieces
            .par_iter()
            .map(|piece| {
                let mut sum = Logarithms::default();
                for point in piece.clone() {
                    for row in self.starts[point]..self.starts[point + 1] {
                        let place = scene.place(self.frame[row] as usize, point, self.pixels[row]);
                        let ([xx, xy, yy], [x, y]) = (self.precision[row], place.off);
                        sum.add((xx * x * x + 2.0 * xy * x * y + yy * y * y) * per_square);
                    }
                }
                sum.total()
            })
            .collect();
        Ok(sums.iter().sum())
    }
}

/// A sum of ln(1 + s), with as many digits where s is tiny.
#[derive(Default)]
struct Logarithms {
    sum: f64,
    /// The product of the last factors 1 + s, less 1.
    product: f64,
    factors: usize,
}

impl Logarithms {
    #[inline(always)]
    fn add(&mut self, s: f64) {
        if s < LARGEST {
            self.product += s + self.product * s;
            self.factors += 1;
            if self.factors == TOGETHER {
                self.sum += self.product.ln_1p();
                (self.product, self.factors) = (0.0, 0);
            }
        } else {
            self.sum += s.ln_1p();
        }
    }

    fn total(self) -> f64 {
        self.sum + self.product.ln_1p()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_together_are_those_of_each() {
        let mut rng = fastrand::Rng::with_seed(0);
        for (low, high) in [(-40.0, -20.0), (-3.0, 3.0), (50.0, 70.0), (300.0, 308.0)] {
            let values: Vec<f64> = (0..99)
                .map(|_| 10f64.powf(low + (high - low) * rng.f64()))
                .collect();
            let mut sum = Logarithms::default();
            values.iter().for_each(|&value| sum.add(value));
            let expected: f64 = values.iter().map(|value| value.ln_1p()).sum();
            assert!((sum.total() - expected).abs() <= 1e-13 * expected);
        }
        let mut sum = Logarithms::default();
        for value in [1.0, f64::NAN, f64::INFINITY] {
            sum.add(value);
        }
        assert!(sum.total().is_nan());
    }
}

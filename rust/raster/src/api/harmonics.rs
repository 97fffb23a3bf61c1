//! Colours that depend on the direction of view: real spherical harmonics to degree 3, and back for gradients.

use crate::color::harmonics::{HarmonicSums, HarmonicsGradients};
use crate::error::RasterError;
use crate::input::gaussians::check_length;
use crate::pipeline::scalar::Scalar;

/// Spherical harmonics of N Gaussians seen from one or more places, checked.
///
/// Signs and order are those of 3D Gaussian splatting, whose `.ply` files hold such coefficients; there the colour is
/// the value of [`Harmonics::evaluate`] plus ½, limited to at least 0.
///
/// ```
/// use bigs_raster::Harmonics;
///
/// // Constant and linear part of one Gaussian: three values per basis function, of red, green and blue.
/// let coefficients = [1.0, 1.0, 1.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
/// let from_above_and_below = [[0.0, -2.0, 0.0], [0.0, 3.0, 0.0]];
/// let colors = Harmonics::new(1, 4, &from_above_and_below, &coefficients, None)?.evaluate();
/// assert!(colors[0][1] > colors[1][1] && colors[0][0] == colors[1][0]);
/// # Ok::<(), bigs_raster::RasterError>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Harmonics<'a, T>(HarmonicSums<'a, T>);

impl<'a, T: Scalar> Harmonics<'a, T> {
    /// Checks lengths. Values are not scanned: one that is not finite makes a colour that is refused later.
    ///
    /// * `degree`: 0 to 3; higher bands of the coefficients are left out
    /// * `bases`: basis functions each Gaussian has coefficients for, at least (degree + 1)²
    /// * `dirs`: from the camera to the Gaussian, of any length; all Gaussians for the first place, then for the next.
    ///   In the zero direction the bands above the constant one vanish or are constant
    /// * `coefficients`: Gaussians × `bases` × 3
    /// * `mask`: one per direction; where it is false the colour is 0 and has no gradient
    ///
    /// # Errors
    /// A degree that is too high for the engine or the coefficients, or a length that does not fit.
    pub fn new(
        degree: usize,
        bases: usize,
        dirs: &'a [[T; 3]],
        coefficients: &'a [T],
        mask: Option<&'a [bool]>,
    ) -> Result<Self, RasterError> {
        HarmonicSums::new(degree, bases, dirs, coefficients, mask).map(Self)
    }

    /// Red, green and blue of every direction, in their order.
    #[must_use]
    pub fn evaluate(&self) -> Vec<[T; 3]> {
        T::harmonics(&self.0)
    }

    /// Gradients of a loss, given those with respect to the colours.
    ///
    /// # Errors
    /// `v_colors` of another length than the directions.
    pub fn vjp(
        &self,
        v_colors: &[[T; 3]],
        want_dirs: bool,
        want_coefficients: bool,
    ) -> Result<HarmonicsGradients<T>, RasterError> {
        check_length("v_colors", self.0.dirs.len(), v_colors.len())?;
        let mut out = HarmonicsGradients {
            dirs: vec![[T::ZERO; 3]; if want_dirs { self.0.dirs.len() } else { 0 }],
            coefficients: vec![
                T::ZERO;
                if want_coefficients {
                    self.0.coefficients.len()
                } else {
                    0
                }
            ],
        };
        T::harmonics_vjp(&self.0, v_colors, &mut out);
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_finite_differences() {
        for (degree, bases) in [(0, 1), (1, 4), (2, 9), (3, 16), (1, 16)] {
            let mut value = 0.3f64;
            let mut next = || {
                value = (value * 997.0 + 0.123).fract();
                2.0 * value - 1.0
            };
            let coefficients: Vec<f64> = (0..2 * 3 * bases).map(|_| next()).collect();
            let dirs: Vec<[f64; 3]> = (0..4).map(|_| [next(), next(), next()]).collect();
            let v: Vec<[f64; 3]> = (0..4).map(|_| [next(), next(), next()]).collect();
            let mask = [true, true, false, true];
            let loss = |dirs: &[[f64; 3]], coefficients: &[f64]| -> f64 {
                let colors = Harmonics::new(degree, bases, dirs, coefficients, Some(&mask)).unwrap();
                colors
                    .evaluate()
                    .as_flattened()
                    .iter()
                    .zip(v.as_flattened())
                    .map(|(a, b)| a * b)
                    .sum()
            };
            let harmonics = Harmonics::new(degree, bases, &dirs, &coefficients, Some(&mask)).unwrap();
            let gradients = harmonics.vjp(&v, true, true).unwrap();
            let h = 1e-6;
            for i in 0..12 {
                let mut moved = [dirs.clone(), dirs.clone()];
                moved[0].as_flattened_mut()[i] += h;
                moved[1].as_flattened_mut()[i] -= h;
                let expected = (loss(&moved[0], &coefficients) - loss(&moved[1], &coefficients)) / (2.0 * h);
                assert!(
                    (gradients.dirs.as_flattened()[i] - expected).abs() < 1e-8,
                    "{degree} dir {i}"
                );
            }
            for i in 0..coefficients.len() {
                let mut moved = [coefficients.clone(), coefficients.clone()];
                moved[0][i] += h;
                moved[1][i] -= h;
                let expected = (loss(&dirs, &moved[0]) - loss(&dirs, &moved[1])) / (2.0 * h);
                assert!(
                    (gradients.coefficients[i] - expected).abs() < 1e-8,
                    "{degree} coefficient {i}"
                );
            }
        }
    }

    #[test]
    fn hopeless_directions_have_a_colour_and_no_gradient() {
        let coefficients = [0.5f32; 48];
        let dirs = [[0.0; 3], [1e-30, 0.0, 0.0], [1e30, 0.0, 1e30]];
        let harmonics = Harmonics::new(3, 16, &dirs, &coefficients, None).unwrap();
        assert!(harmonics.evaluate().as_flattened().iter().all(|v| v.is_finite()));
        let gradients = harmonics.vjp(&[[1.0; 3]; 3], true, true).unwrap();
        assert_eq!(gradients.dirs[0], [0.0; 3]);
        assert!(gradients.dirs.as_flattened().iter().all(|v| v.is_finite()));
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let dirs = [[0.0f64, 0.0, 1.0]; 3];
        let refuse = |degree, bases, coefficients: &[f64]| {
            Harmonics::new(degree, bases, &dirs, coefficients, None)
                .unwrap_err()
                .to_string()
        };
        assert_eq!(
            refuse(4, 25, &[0.0; 75]),
            "sh_degree: expected at most 3 and (degree + 1)² of the 25 bases, found 4"
        );
        assert!(refuse(2, 4, &[0.0; 12]).starts_with("sh_degree"));
        assert!(refuse(0, 1, &[0.0; 4]).starts_with("coefficients: expected 3"));
        assert!(refuse(0, 1, &[0.0; 6]).starts_with("dirs: expected 2"));
    }
}

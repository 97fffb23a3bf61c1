//! Colours that depend on the direction of view: real spherical harmonics to degree 3, and back for gradients.

use rayon::prelude::*;

use crate::error::RasterError;
use crate::gaussians::check_length;
use crate::real::Real;
use crate::sh_basis::{basis, basis_vjp};

/// The highest degree.
const MAX_DEGREE: usize = 3;

/// Gaussians handled by one task. Fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 512;

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
pub struct Harmonics<'a, T> {
    degree: usize,
    bases: usize,
    dirs: &'a [[T; 3]],
    coefficients: &'a [T],
    mask: Option<&'a [bool]>,
}

/// Gradients of what [`Harmonics`] was made of; empty if not asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct HarmonicsGradients<T> {
    /// Of the directions, at right angles to each.
    pub dirs: Vec<[T; 3]>,
    /// Of the coefficients, summed over the places.
    pub coefficients: Vec<T>,
}

impl<'a, T: Real> Harmonics<'a, T> {
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
        if degree > MAX_DEGREE || (degree + 1) * (degree + 1) > bases {
            return Err(RasterError::BadDegree { degree, bases });
        }
        let n = coefficients.len() / (3 * bases);
        check_length("coefficients", n * 3 * bases, coefficients.len())?;
        let places = dirs.len().checked_div(n).unwrap_or(0);
        check_length("dirs", places * n, dirs.len())?;
        if let Some(mask) = mask {
            check_length("mask", dirs.len(), mask.len())?;
        }
        Ok(Self {
            degree,
            bases,
            dirs,
            coefficients,
            mask,
        })
    }

    /// Red, green and blue of every direction, in their order.
    #[must_use]
    pub fn evaluate(&self) -> Vec<[T; 3]> {
        T::harmonics(self)
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
        check_length("v_colors", self.dirs.len(), v_colors.len())?;
        let mut out = HarmonicsGradients {
            dirs: vec![[T::ZERO; 3]; if want_dirs { self.dirs.len() } else { 0 }],
            coefficients: vec![
                T::ZERO;
                if want_coefficients {
                    self.coefficients.len()
                } else {
                    0
                }
            ],
        };
        T::harmonics_vjp(self, v_colors, &mut out);
        Ok(out)
    }

    pub(crate) fn values(&self) -> Vec<[T; 3]> {
        match self.degree {
            0 => self.evaluate_bands::<1>(),
            1 => self.evaluate_bands::<4>(),
            2 => self.evaluate_bands::<9>(),
            _ => self.evaluate_bands::<16>(),
        }
    }

    pub(crate) fn add_vjp(&self, v_colors: &[[T; 3]], out: &mut HarmonicsGradients<T>) {
        match self.degree {
            0 => self.vjp_bands::<1>(v_colors, out),
            1 => self.vjp_bands::<4>(v_colors, out),
            2 => self.vjp_bands::<9>(v_colors, out),
            _ => self.vjp_bands::<16>(v_colors, out),
        }
    }

    fn gaussians(&self) -> usize {
        self.coefficients.len() / (3 * self.bases)
    }

    fn shown(&self, at: usize) -> bool {
        self.mask.is_none_or(|mask| mask[at])
    }

    fn rows<const B: usize>(&self, gaussian: usize) -> &[[T; 3]] {
        let own = &self.coefficients[gaussian * 3 * self.bases..][..3 * B];
        own.as_chunks().0
    }

    fn evaluate_bands<const B: usize>(&self) -> Vec<[T; 3]> {
        let n = self.gaussians();
        let mut colors = vec![[T::ZERO; 3]; self.dirs.len()];
        let pieces = by_chunk(&mut colors, n);
        pieces.into_par_iter().enumerate().for_each(|(chunk, places)| {
            for (place, colors) in places.into_iter().enumerate() {
                for (local, color) in colors.iter_mut().enumerate() {
                    let gaussian = chunk * CHUNK + local;
                    let at = place * n + gaussian;
                    if self.shown(at) {
                        let basis = basis::<T, B>(unit(self.dirs[at]).0);
                        for (b, row) in basis.iter().zip(self.rows::<B>(gaussian)) {
                            for c in 0..3 {
                                color[c] += *b * row[c];
                            }
                        }
                    }
                }
            }
        });
        colors
    }

    fn vjp_bands<const B: usize>(&self, v_colors: &[[T; 3]], out: &mut HarmonicsGradients<T>) {
        let n = self.gaussians();
        let chunks = n.div_ceil(CHUNK);
        let places = self.dirs.len().checked_div(n).unwrap_or(0);
        let mut v_dirs = by_chunk(&mut out.dirs, n);
        v_dirs.resize_with(chunks, Vec::new);
        let mut v_coefficients: Vec<&mut [T]> = out.coefficients.chunks_mut(CHUNK * 3 * self.bases).collect();
        v_coefficients.resize_with(chunks, || &mut []);
        (v_dirs, v_coefficients).into_par_iter().enumerate().for_each(
            |(chunk, (mut v_dirs, v_coefficients))| {
                let first = chunk * CHUNK;
                for gaussian in first..(first + CHUNK).min(n) {
                    let local = gaussian - first;
                    let rows = self.rows::<B>(gaussian);
                    for place in 0..places {
                        let at = place * n + gaussian;
                        let v = v_colors[at];
                        // What no pixel sees has no gradient, and its coefficients need not be read.
                        if !self.shown(at) || v == [T::ZERO; 3] {
                            continue;
                        }
                        let (direction, inverse_length) = unit(self.dirs[at]);
                        if let Some(sums) = v_coefficients.get_mut(local * 3 * self.bases..) {
                            let basis = basis::<T, B>(direction);
                            for (b, sums) in basis.iter().zip(sums.as_chunks_mut::<3>().0) {
                                for c in 0..3 {
                                    sums[c] += *b * v[c];
                                }
                            }
                        }
                        if let Some(v_dirs) = v_dirs.get_mut(place) {
                            let mut v_basis = [T::ZERO; B];
                            for (v_b, row) in v_basis.iter_mut().zip(rows) {
                                *v_b = row[0] * v[0] + row[1] * v[1] + row[2] * v[2];
                            }
                            let v_unit = basis_vjp(direction, &v_basis);
                            let radial = direction[0] * v_unit[0]
                                + direction[1] * v_unit[1]
                                + direction[2] * v_unit[2];
                            v_dirs[local] =
                                [0, 1, 2].map(|i| inverse_length * (v_unit[i] - direction[i] * radial));
                        }
                    }
                }
            },
        );
    }
}

/// For each chunk of Gaussians, its part of every place.
fn by_chunk<U>(values: &mut [U], gaussians: usize) -> Vec<Vec<&mut [U]>> {
    if values.is_empty() {
        return Vec::new();
    }
    let places = values.len() / gaussians;
    let mut chunks: Vec<Vec<&mut [U]>> = (0..gaussians.div_ceil(CHUNK))
        .map(|_| Vec::with_capacity(places))
        .collect();
    for place in values.chunks_exact_mut(gaussians) {
        for (chunk, part) in chunks.iter_mut().zip(place.chunks_mut(CHUNK)) {
            chunk.push(part);
        }
    }
    chunks
}

/// The direction of a vector and the reciprocal of its length; zeros for the zero vector.
#[inline(always)]
fn unit<T: Real>(v: [T; 3]) -> ([T; 3], T) {
    // Divided by the largest part first, so that the square of a short or a long one is still a number.
    let largest = v[0].abs().greater(v[1].abs()).greater(v[2].abs());
    if largest == T::ZERO {
        return ([T::ZERO; 3], T::ZERO);
    }
    let v = v.map(|x| x / largest);
    let inverse = T::ONE / (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    (v.map(|x| x * inverse), inverse / largest)
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

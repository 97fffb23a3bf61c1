//! Colours that depend on the direction of view: real spherical harmonics to degree 3, and back for gradients.

use rayon::prelude::*;

use crate::error::RasterError;
use crate::gaussians::check_length;
use crate::real::Real;

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

/// √(1 / 4π)
const BAND_0: f64 = 0.282_094_791_773_878_14;
/// √(3 / 4π)
const BAND_1: f64 = 0.488_602_511_902_919_9;
/// √(15 / 4π), half of it, and √(5 / 16π) times 3 and 1
const BAND_2: [f64; 4] = [
    1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
    0.946_174_695_757_560_1,
    0.315_391_565_252_520_05,
];
/// √(35 / 32π), √(105 / 4π) and half of it, √(21 / 32π) times 5 and 1, √(7 / 16π) times 5 and 3
const BAND_3: [f64; 7] = [
    0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    1.445_305_721_320_277,
    2.285_228_997_322_329,
    0.457_045_799_464_465_8,
    1.865_881_662_950_577,
    1.119_528_997_770_346,
];

/// The first B basis functions at a unit vector.
#[inline(always)]
fn basis<T: Real, const B: usize>([x, y, z]: [T; 3]) -> [T; B] {
    let mut out = [T::ZERO; B];
    out[0] = T::of(BAND_0);
    if B > 1 {
        let a = T::of(BAND_1);
        out[1] = -a * y;
        out[2] = a * z;
        out[3] = -a * x;
    }
    if B > 4 {
        let [a, b, c, d] = BAND_2.map(T::of);
        out[4] = a * x * y;
        out[5] = -a * y * z;
        out[6] = c * z * z - d;
        out[7] = -a * x * z;
        out[8] = b * (x * x - y * y);
    }
    if B > 9 {
        let [a, b, c, d, e, f, g] = BAND_3.map(T::of);
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let three = T::of(3.0);
        out[9] = -a * y * (three * xx - yy);
        out[10] = b * x * y * z;
        out[11] = y * (e - d * zz);
        out[12] = z * (f * zz - g);
        out[13] = x * (e - d * zz);
        out[14] = c * z * (xx - yy);
        out[15] = -a * x * (xx - three * yy);
    }
    out
}

/// The vjp of [`basis`], as if its polynomials were meant everywhere; only the part along the sphere counts.
#[inline(always)]
fn basis_vjp<T: Real, const B: usize>([x, y, z]: [T; 3], v: &[T; B]) -> [T; 3] {
    let mut out = [T::ZERO; 3];
    let two = T::of(2.0);
    if B > 1 {
        let a = T::of(BAND_1);
        out = [-a * v[3], -a * v[1], a * v[2]];
    }
    if B > 4 {
        let [a, b, c, _] = BAND_2.map(T::of);
        out[0] += a * (y * v[4] - z * v[7]) + two * b * x * v[8];
        out[1] += a * (x * v[4] - z * v[5]) - two * b * y * v[8];
        out[2] += two * c * z * v[6] - a * (y * v[5] + x * v[7]);
    }
    if B > 9 {
        let [a, b, c, d, e, f, g] = BAND_3.map(T::of);
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (three, six) = (T::of(3.0), T::of(6.0));
        let (flat, sector) = (e - d * zz, three * a * (xx - yy));
        out[0] += b * y * z * v[10] + flat * v[13] + two * c * x * z * v[14]
            - six * a * x * y * v[9]
            - sector * v[15];
        out[1] += b * x * z * v[10] + flat * v[11] - two * c * y * z * v[14] - sector * v[9]
            + six * a * x * y * v[15];
        out[2] += b * x * y * v[10] + c * (xx - yy) * v[14] + (three * f * zz - g) * v[12]
            - two * d * z * (y * v[11] + x * v[13]);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points and weights that integrate polynomials of degree 7 over the sphere: Gauss in z, even steps around.
    fn quadrature() -> Vec<([f64; 3], f64)> {
        let nodes: [(f64, f64); 4] = [
            (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
            (-0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
        ];
        let around = 8;
        let step = std::f64::consts::TAU / f64::from(around);
        nodes
            .iter()
            .flat_map(|&(z, weight)| {
                (0..around).map(move |k| {
                    let (angle, ring) = (step * f64::from(k), (1.0 - z * z).sqrt());
                    ([ring * angle.cos(), ring * angle.sin(), z], weight * step)
                })
            })
            .collect()
    }

    #[test]
    fn the_basis_is_orthonormal() {
        for i in 0..16 {
            for j in 0..16 {
                let product: f64 = quadrature()
                    .iter()
                    .map(|&(point, weight)| {
                        let values = basis::<f64, 16>(point);
                        weight * values[i] * values[j]
                    })
                    .sum();
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((product - expected).abs() < 1e-12, "{i} {j}: {product}");
            }
        }
    }

    #[test]
    fn signs_are_those_of_gaussian_splatting() {
        // Condon-Shortley phase: odd orders are negative along their axis.
        let [along_x, along_y, along_z] =
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(basis::<f64, 16>);
        assert!(along_y[1] < 0.0 && along_z[2] > 0.0 && along_x[3] < 0.0);
        assert!(along_z[6] > 0.0 && along_x[8] > 0.0 && along_z[12] > 0.0);
        assert!(along_y[9] > 0.0 && along_x[15] < 0.0 && along_x[13] > 0.0);
        let diagonal = basis::<f64, 16>(unit([1.0, 1.0, 1.0]).0);
        assert!(diagonal[4] > 0.0 && diagonal[5] < 0.0 && diagonal[7] < 0.0 && diagonal[10] > 0.0);
    }

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

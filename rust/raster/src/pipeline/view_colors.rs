//! The colours that a camera sees of Gaussians with spherical harmonics, and back for gradients.

use crate::color::harmonics::{HarmonicSums, HarmonicsGradients};
use crate::error::RasterError;
use crate::input::camera::Camera;
use crate::input::gaussians::{Coefficients, check_finite};
use crate::math::covariance::{dot, three};
use crate::memory::results::filled_with;
use crate::pipeline::scalar::Scalar;

/// From the camera to each Gaussian.
fn directions<T: Scalar>(means: &[[T; 3]], camera: &Camera<T>) -> Vec<[T; 3]> {
    let eye = camera.centre();
    means.iter().map(|mean| three(|i| mean[i] - eye[i])).collect()
}

/// Red, green and blue of every Gaussian: the sum of its harmonics plus ½, at least 0.
///
/// # Errors
/// A colour beyond the scalar's range.
pub(crate) fn view_colors<T: Scalar>(
    means: &[[T; 3]],
    harmonics: &Coefficients<'_, T>,
    camera: &Camera<T>,
) -> Result<Vec<T>, RasterError> {
    let dirs = directions(means, camera);
    let sums = HarmonicSums::new(harmonics.degree, harmonics.bases, &dirs, harmonics.values, None)?;
    let mut colors = T::harmonics(&sums).into_flattened();
    let half = T::of(0.5);
    for color in &mut colors {
        // NaN stays, to be refused.
        let shifted = *color + half;
        *color = if shifted < T::ZERO { T::ZERO } else { shifted };
    }
    check_finite("harmonics", &colors)?;
    Ok(colors)
}

/// The vjp of [`view_colors`]: adds to the gradients of means and world-to-camera matrix, and returns that of the
/// coefficients. A colour that is limited to 0 passes none.
pub(crate) fn view_colors_vjp<T: Scalar>(
    means: &[[T; 3]],
    harmonics: &Coefficients<'_, T>,
    camera: &Camera<T>,
    colors: &[T],
    v_colors: &mut [T],
    v_means: &mut [[T; 3]],
    v_viewmat: &mut [[T; 4]; 3],
) -> Result<Vec<T>, RasterError> {
    for (v, &color) in v_colors.iter_mut().zip(colors) {
        if color == T::ZERO {
            *v = T::ZERO;
        }
    }
    let dirs = directions(means, camera);
    let sums = HarmonicSums::new(harmonics.degree, harmonics.bases, &dirs, harmonics.values, None)?;
    let mut v = HarmonicsGradients {
        dirs: filled_with("means", [T::ZERO; 3], &[means.len()])?,
        coefficients: filled_with("colors", T::ZERO, &[harmonics.values.len()])?,
    };
    T::harmonics_vjp(&sums, v_colors.as_chunks().0, &mut v);
    let mut total = [0.0f64; 3];
    for (sum, v) in v_means.iter_mut().zip(&v.dirs) {
        for i in 0..3 {
            sum[i] += v[i];
            total[i] += v[i].as_f64();
        }
    }
    // The eye is e = −R⁻¹ t, so de = −R⁻¹ (dR e + dt), and every direction has −e in it.
    let eye = camera.centre();
    for (row, column) in v_viewmat.iter_mut().zip(camera.inverse_columns()) {
        let v_row = T::of(dot(column, total));
        for i in 0..3 {
            row[i] += v_row * eye[i];
        }
        row[3] += v_row;
    }
    Ok(v.coefficients)
}

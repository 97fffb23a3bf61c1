//! Borrowed, checked arrays of Gaussians.

use crate::error::RasterError;
use crate::input::settings::RenderMode;
use crate::math::real::Real;
use crate::memory::results::product;

/// Most colour channels.
const MAX_CHANNELS: usize = 1 << 16;

/// Coefficients of spherical harmonics in place of colours.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Coefficients<'a, T> {
    pub(crate) degree: usize,
    pub(crate) bases: usize,
    /// Gaussians × bases × red, green, blue.
    pub(crate) values: &'a [T],
}

/// N Gaussians as flat arrays, borrowed from the caller.
#[derive(Clone, Copy, Debug)]
pub struct Gaussians<'a, T> {
    pub(crate) means: &'a [[T; 3]],
    pub(crate) quats: &'a [[T; 4]],
    pub(crate) scales: &'a [[T; 3]],
    pub(crate) opacities: &'a [T],
    pub(crate) colors: &'a [T],
    pub(crate) channels: usize,
    /// If there are any, `colors` is empty until a camera is known.
    pub(crate) harmonics: Option<Coefficients<'a, T>>,
}

impl<'a, T: Real> Gaussians<'a, T> {
    /// Checks lengths and finiteness.
    ///
    /// * `means`: centres in the world
    /// * `quats`: rotations, w x y z, of any length; the zero quaternion is taken as no rotation
    /// * `scales`: standard deviations along the rotated axes
    /// * `opacities`: in [0, 1]; above 1 they are opaque further out from the centre (alpha is limited, as in gsplat), and
    ///   a Gaussian below 0 is not there
    /// * `colors`: `channels` values per Gaussian; up to 65,536, or none at all for depth alone
    ///
    /// # Errors
    /// Names the first array whose length does not fit `means` or that holds a value that is not finite. More Gaussians or
    /// channels than can be numbered.
    pub fn new(
        means: &'a [[T; 3]],
        quats: &'a [[T; 4]],
        scales: &'a [[T; 3]],
        opacities: &'a [T],
        colors: &'a [T],
        channels: usize,
    ) -> Result<Self, RasterError> {
        check_counts(means.len(), channels)?;
        check_length("quats", means.len(), quats.len())?;
        check_length("scales", means.len(), scales.len())?;
        check_length("opacities", means.len(), opacities.len())?;
        check_length("colors", product(&[means.len(), channels]), colors.len())?;
        check_finite("means", means.as_flattened())?;
        check_finite("quats", quats.as_flattened())?;
        check_finite("scales", scales.as_flattened())?;
        check_finite("opacities", opacities)?;
        check_finite("colors", colors)?;
        Ok(Self {
            means,
            quats,
            scales,
            opacities,
            colors,
            channels,
            harmonics: None,
        })
    }

    /// The same with colours that depend on the direction of view: real spherical harmonics, as the `.ply` files of 3D
    /// Gaussian splatting hold them. A colour is the sum of the harmonics in the direction from the camera's centre to
    /// the Gaussian's, plus ½, and at least 0.
    ///
    /// * `degree`: 0 to 3; higher bands of the coefficients are left out
    /// * `bases`: basis functions each Gaussian has coefficients for, at least (degree + 1)²
    /// * `coefficients`: Gaussians × `bases` × red, green, blue
    ///
    /// # Errors
    /// As [`Gaussians::new`], and a degree that is too high for the engine or the coefficients.
    pub fn with_harmonics(
        means: &'a [[T; 3]],
        quats: &'a [[T; 4]],
        scales: &'a [[T; 3]],
        opacities: &'a [T],
        degree: usize,
        bases: usize,
        coefficients: &'a [T],
    ) -> Result<Self, RasterError> {
        check_degree(degree, bases)?;
        check_length(
            "coefficients",
            product(&[means.len(), bases, 3]),
            coefficients.len(),
        )?;
        check_finite("coefficients", coefficients)?;
        let harmonics = Coefficients {
            degree,
            bases,
            values: coefficients,
        };
        Ok(Self {
            channels: 3,
            harmonics: Some(harmonics),
            ..Self::new(means, quats, scales, opacities, &[], 0)?
        })
    }

    /// The same Gaussians with these colours of red, green and blue in place of harmonics.
    pub(crate) fn with_colors<'b>(&self, colors: &'b [T]) -> Gaussians<'b, T>
    where
        'a: 'b,
    {
        Gaussians {
            colors,
            harmonics: None,
            ..*self
        }
    }

    /// Values of what colours are made of.
    pub(crate) fn color_values(&self) -> usize {
        self.harmonics
            .map_or(self.len() * self.channels, |harmonics| harmonics.values.len())
    }

    /// How many Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }
}

/// Whether this many Gaussians and channels can be rendered.
pub(crate) fn check_counts(gaussians: usize, channels: usize) -> Result<(), RasterError> {
    // Gaussians are numbered with 31 bits: median ids are signed.
    if gaussians > i32::MAX as usize {
        return Err(RasterError::BadSize {
            name: "means",
            expected: "fewer than 2^31 Gaussians",
            got: gaussians,
        });
    }
    if channels > MAX_CHANNELS {
        return Err(RasterError::BadSize {
            name: "colors",
            expected: "at most 65536 channels",
            got: channels,
        });
    }
    Ok(())
}

/// Whether there are colours to render, if the mode asks for them.
pub(crate) fn check_channels(mode: RenderMode, channels: usize) -> Result<(), RasterError> {
    if mode.has_colors() && channels == 0 {
        return Err(RasterError::BadSize {
            name: "colors",
            expected: "at least one channel in a mode with colours",
            got: 0,
        });
    }
    Ok(())
}

/// The highest degree of spherical harmonics.
const MAX_DEGREE: usize = 3;
/// The most basis functions that coefficients may be given for.
const MAX_BASES: usize = 1 << 16;

/// Whether there are harmonics of this degree, and coefficients for them.
pub(crate) fn check_degree(degree: usize, bases: usize) -> Result<(), RasterError> {
    if degree > MAX_DEGREE || (degree + 1) * (degree + 1) > bases || bases > MAX_BASES {
        return Err(RasterError::BadDegree { degree, bases });
    }
    Ok(())
}

pub(crate) fn check_length(name: &'static str, expected: usize, got: usize) -> Result<(), RasterError> {
    if expected == got {
        Ok(())
    } else {
        Err(RasterError::LengthMismatch { name, expected, got })
    }
}

pub(crate) fn check_finite<T: Real>(name: &'static str, values: &[T]) -> Result<(), RasterError> {
    match T::first_not_finite(values) {
        Some(index) => Err(RasterError::NotFinite { name, index }),
        None => Ok(()),
    }
}

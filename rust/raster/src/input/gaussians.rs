//! Borrowed, checked arrays of Gaussians.

use crate::error::RasterError;
use crate::input::settings::RenderMode;
use crate::math::real::Real;
use crate::memory::results::product;

/// Most colour channels.
const MAX_CHANNELS: usize = 1 << 16;

/// N Gaussians as flat arrays, borrowed from the caller.
#[derive(Clone, Copy, Debug)]
pub struct Gaussians<'a, T> {
    pub(crate) means: &'a [[T; 3]],
    pub(crate) quats: &'a [[T; 4]],
    pub(crate) scales: &'a [[T; 3]],
    pub(crate) opacities: &'a [T],
    pub(crate) colors: &'a [T],
    pub(crate) channels: usize,
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
        })
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

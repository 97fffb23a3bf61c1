//! Every threshold of the renderer, each with its reason.

use crate::error::RasterError;
use crate::math::real::Real;
use crate::simd::level::SimdLevel;

/// The rules of the renderer. The defaults are gsplat's, so that images agree.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterSettings {
    /// Side of a square tile in pixels: 4, 8, 16 or 32. A tile has one depth-ordered list; 32 measured fastest.
    pub tile_size: u32,
    /// Added to both variances on screen, in px²: a Gaussian thinner than a pixel still covers one.
    pub eps2d: f64,
    /// Gaussians whose centre is nearer than this along the camera axis are skipped: the projection is singular at 0.
    pub near_plane: f64,
    /// Gaussians whose centre is further than this are skipped.
    pub far_plane: f64,
    /// Gaussians whose radii on screen are both at most this many pixels are skipped; 0 keeps all.
    pub radius_clip: f64,
    /// A (pixel, Gaussian) pair with alpha below this is skipped: 1/255 is what an 8-bit image can show. 0 skips none.
    pub alpha_threshold: f64,
    /// Alpha is limited to this, so that transmittance never reaches 0 and gradients stay finite.
    pub max_alpha: f64,
    /// A pixel stops before the Gaussian that would bring its transmittance to this or less. Numbers below the floor of the
    /// scalar, 1e-30 for `f32` and 1e-290 for `f64`, stand for that floor, 0 too: nothing behind it can be seen, and the
    /// backward pass could not divide by what is left.
    pub min_transmittance: f64,
    /// Degree of the polynomial that stands for powers of two in `f32`: 3, 4 or 5, with relative errors of alpha of
    /// 1e-4, 3e-6 and 1e-7, the last being those of the type. `f64` has one of degree 12, and only takes 5 here.
    pub exp_degree: u32,
    /// Scale opacities by what `eps2d` added to the area (Mip-Splatting), so that thin Gaussians do not grow brighter.
    pub antialiased: bool,
}

impl Default for RasterSettings {
    fn default() -> Self {
        Self {
            tile_size: 32,
            eps2d: 0.3,
            near_plane: 0.01,
            far_plane: 1e10,
            radius_clip: 0.0,
            alpha_threshold: 1.0 / 255.0,
            max_alpha: 0.999,
            min_transmittance: 1e-4,
            exp_degree: 5,
            antialiased: false,
        }
    }
}

impl RasterSettings {
    /// Checks that every setting is in its range.
    ///
    /// # Errors
    /// [`RasterError::BadSetting`] names the first that is not.
    pub fn validate(&self) -> Result<(), RasterError> {
        let checks = [
            (
                matches!(self.tile_size, 4 | 8 | 16 | 32),
                "tile_size",
                "4, 8, 16 or 32",
            ),
            (
                self.eps2d >= 0.0 && self.eps2d.is_finite(),
                "eps2d",
                "a finite number of at least 0",
            ),
            (
                self.near_plane > 0.0 && self.near_plane.is_finite(),
                "near_plane",
                "a finite number above 0",
            ),
            (
                self.far_plane > self.near_plane,
                "far_plane",
                "a number above near_plane",
            ),
            (self.radius_clip >= 0.0, "radius_clip", "a number of at least 0"),
            (
                (0.0..1.0).contains(&self.alpha_threshold),
                "alpha_threshold",
                "a number in [0, 1)",
            ),
            (
                self.max_alpha > 0.0 && self.max_alpha < 1.0,
                "max_alpha",
                "a number in (0, 1)",
            ),
            (
                (0.0..1.0).contains(&self.min_transmittance),
                "min_transmittance",
                "a number in [0, 1)",
            ),
            (matches!(self.exp_degree, 3..=5), "exp_degree", "3, 4 or 5"),
        ];
        match checks.into_iter().find(|(ok, ..)| !ok) {
            Some((_, name, expected)) => Err(RasterError::BadSetting { name, expected }),
            None => Ok(()),
        }
    }
}

/// What an image holds, named as in gsplat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum RenderMode {
    /// The colours.
    Rgb,
    /// Accumulated depth: camera z weighted as the colours are.
    Depth,
    /// Expected depth: accumulated depth divided by alpha.
    ExpectedDepth,
    /// The colours, then accumulated depth.
    RgbDepth,
    /// The colours, then expected depth.
    RgbExpectedDepth,
}

impl RenderMode {
    /// The mode called `RGB`, `D`, `ED`, `RGB+D` or `RGB+ED`.
    pub fn from_name(name: &str) -> Option<Self> {
        match name {
            "RGB" => Some(Self::Rgb),
            "D" => Some(Self::Depth),
            "ED" => Some(Self::ExpectedDepth),
            "RGB+D" => Some(Self::RgbDepth),
            "RGB+ED" => Some(Self::RgbExpectedDepth),
            _ => None,
        }
    }

    /// Whether the image holds the colours.
    pub fn has_colors(self) -> bool {
        matches!(self, Self::Rgb | Self::RgbDepth | Self::RgbExpectedDepth)
    }

    /// Channels of an image of Gaussians with so many.
    pub(crate) fn channels(self, of_gaussians: usize) -> usize {
        let colors = if self.has_colors() { of_gaussians } else { 0 };
        colors.saturating_add(usize::from(self.has_depth()))
    }

    /// Whether its last channel is depth.
    pub fn has_depth(self) -> bool {
        self != Self::Rgb
    }

    /// Whether that depth is divided by alpha.
    pub fn expects_depth(self) -> bool {
        matches!(self, Self::ExpectedDepth | Self::RgbExpectedDepth)
    }
}

/// The settings in the scalar of a render, as the stages use them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits<T> {
    pub(crate) tile_size: usize,
    pub(crate) eps2d: T,
    pub(crate) near: T,
    pub(crate) far: T,
    pub(crate) radius_clip: T,
    pub(crate) alpha_threshold: T,
    pub(crate) max_alpha: T,
    pub(crate) min_transmittance: T,
    pub(crate) exp_degree: u32,
    pub(crate) antialiased: bool,
    /// What the stages run at.
    pub(crate) level: SimdLevel,
}

impl<T: Real> Limits<T> {
    pub(crate) fn new(settings: &RasterSettings) -> Result<Self, RasterError> {
        settings.validate()?;
        if !T::HAS_EXP_DEGREES && settings.exp_degree != RasterSettings::default().exp_degree {
            return Err(RasterError::BadSetting {
                name: "exp_degree",
                expected: "5 with 64-bit floats, which have one degree only",
            });
        }
        // In `f32` numbers close enough to 1 are 1, and the transmittance behind an alpha of 1 cannot be divided by.
        if !(T::of(settings.max_alpha) < T::ONE) {
            return Err(RasterError::BadSetting {
                name: "max_alpha",
                expected: "a number in (0, 1) that the scalar can tell from 1",
            });
        }
        Ok(Self {
            tile_size: settings.tile_size as usize,
            eps2d: T::of(settings.eps2d),
            near: T::of(settings.near_plane),
            far: T::of(settings.far_plane),
            radius_clip: T::of(settings.radius_clip),
            alpha_threshold: T::of(settings.alpha_threshold),
            max_alpha: T::of(settings.max_alpha),
            min_transmittance: T::of(settings.min_transmittance).greater(T::TRANSMITTANCE_FLOOR),
            exp_degree: settings.exp_degree,
            antialiased: settings.antialiased,
            level: SimdLevel::chosen()?,
        })
    }
}

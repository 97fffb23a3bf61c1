//! What a caller can get wrong.

use std::fmt;

/// An input that cannot be rendered; the message names the input, what was expected and what was found.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum RasterError {
    /// An array has the wrong number of elements.
    LengthMismatch {
        /// Which array.
        name: &'static str,
        /// Elements expected.
        expected: usize,
        /// Elements found.
        got: usize,
    },
    /// A size is out of its range, or sizes multiply to more than can be numbered.
    BadSize {
        /// Which size.
        name: &'static str,
        /// What is accepted.
        expected: &'static str,
        /// What was found, as far as it can be numbered.
        got: usize,
    },
    /// The memory for a result cannot be had.
    OutOfMemory {
        /// Which array.
        name: &'static str,
        /// Elements it would have.
        elements: usize,
    },
    /// A value is NaN or infinite.
    NotFinite {
        /// Which array.
        name: &'static str,
        /// Position in the flat array.
        index: usize,
    },
    /// A camera whose matrix cannot be inverted, is not a world-to-camera matrix, or has no focal length.
    BadCamera {
        /// What is wrong with it.
        reason: &'static str,
    },
    /// A setting is outside its range.
    BadSetting {
        /// Which setting.
        name: &'static str,
        /// The range that is accepted.
        expected: &'static str,
    },
    /// Spherical harmonics of a degree that the engine or the coefficients do not have.
    BadDegree {
        /// The degree asked for.
        degree: usize,
        /// Basis functions that there are coefficients for.
        bases: usize,
    },
    /// The environment variable `BIGS_RASTER_SIMD` names no level of CPU features that this machine has.
    BadSimdLevel {
        /// Its value.
        found: String,
        /// The levels of this machine, the best first.
        available: Vec<&'static str>,
    },
    /// More Gaussian-tile intersections than a 32-bit index can number.
    TooManyIntersections,
}

impl fmt::Display for RasterError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::LengthMismatch { name, expected, got } => {
                write!(f, "{name}: expected {expected} elements, found {got}")
            }
            Self::BadSize { name, expected, got } => {
                write!(f, "{name}: expected {expected}, found {got}")
            }
            Self::OutOfMemory { name, elements } => {
                write!(
                    f,
                    "{name}: expected memory for {elements} elements, found too little"
                )
            }
            Self::NotFinite { name, index } => {
                write!(
                    f,
                    "{name}: expected finite values, found NaN or infinity at flat index {index}"
                )
            }
            Self::BadCamera { reason } => write!(f, "camera: {reason}"),
            Self::BadSetting { name, expected } => {
                write!(f, "settings.{name}: expected {expected}")
            }
            Self::BadDegree { degree, bases } => {
                write!(
                    f,
                    "sh_degree: expected at most 3 and (degree + 1)² of the {bases} bases, found {degree}"
                )
            }
            Self::BadSimdLevel { found, available } => {
                write!(
                    f,
                    "BIGS_RASTER_SIMD: expected one of {}, found '{found}'",
                    available.join(", ")
                )
            }
            Self::TooManyIntersections => {
                write!(
                    f,
                    "Gaussians: expected fewer than 2^32 Gaussian-tile intersections in one image"
                )
            }
        }
    }
}

impl std::error::Error for RasterError {}

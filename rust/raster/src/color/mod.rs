//! Spherical harmonics: colours that depend on the direction of view.

pub(crate) mod basis;
pub(crate) mod harmonics;

//! What a render is made from, checked.

pub(crate) mod camera;
pub(crate) mod channels;
pub(crate) mod gaussians;
pub(crate) mod glam;
pub(crate) mod owned_gaussians;
pub(crate) mod settings;

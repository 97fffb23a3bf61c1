//! The last stage of the backward pass: from gradients of splats in tiles to those of Gaussians and camera.

pub(crate) mod dispatch;
pub(crate) mod gradients;
pub(crate) mod sum_tiles;

//! The first stage: from Gaussians to splats on the screen and the tiles that each reaches.

pub(crate) mod dispatch;
pub(crate) mod packet;
pub(crate) mod projected;
pub(crate) mod splat;
pub(crate) mod tiles;

//! The third stage, tile by tile: from splats to an image, and from its gradient to one of each splat in each tile.

pub(crate) mod backward;
pub(crate) mod dispatch;
pub(crate) mod forward;
pub(crate) mod incoming;
pub(crate) mod intersection_gradients;
pub(crate) mod kernel;
pub(crate) mod median;
pub(crate) mod scene;

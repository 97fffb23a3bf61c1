//! The stages in order, for one view.

pub(crate) mod scalar;
pub(crate) mod view;
pub(crate) mod view_colors;

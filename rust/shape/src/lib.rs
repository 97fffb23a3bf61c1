//! What many views of an object say about its shape: where the cones of its silhouettes leave room ([`Views::cones`]),
//! what of its surface showed and what hid nothing ([`Views::times_seen`], [`Views::times_empty`]), how far places are
//! beyond planes ([`beyond_planes`]) and pixels from a mask's border ([`border_distances`]), what a symmetry carries onto
//! what was seen ([`Judge`]), and which points of one shape are nearest to those of another ([`Neighbours`]).
//!
//! Arrays are C-contiguous and borrowed; their lengths are checked once, and nothing panics on their values. Work is
//! shared among rayon's threads in pieces of a fixed size, and sums have a fixed order, so that the number of threads
//! changes no bit.

#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    warn(
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::todo,
        clippy::unimplemented
    )
)]

mod border;
mod cones;
mod depths;
mod error;
mod judge;
mod nearest;
mod neighbours;
mod planes;
mod refine;
mod symmetry;
mod views;

pub use border::border_distances;
pub use cones::Cones;
pub use depths::Facing;
pub use error::ShapeError;
pub use judge::{Agreement, Empty, Judge, Samples};
pub use neighbours::Neighbours;
pub use planes::beyond_planes;
pub use symmetry::{Kind, Symmetry};
pub use views::Views;

/// A point or a direction.
pub type Vec3 = [f64; 3];

//! Bundle adjustment: poses of one object in many frames and its points, from where each frame saw them.
//!
//! [`Sightings`] hold what stays the same from step to step. [`Sightings::linearise`] makes Gauss-Newton's normal
//! equations at a [`Scene`], [`Sightings::reduce`] eliminates the points from these (Schur complement), and
//! [`Sightings::point_steps`] says how the points follow the poses. A pose changes by a turn about the object's origin,
//! x_cam = exp(turn) R x + t, and then by a shift: six numbers of each frame that may move.
//!
//! Work is cut into pieces by what was seen, never by the number of threads, and sums over pieces have a fixed order.

mod band;
mod border;
mod cost;
mod glance;
mod linearise;
mod points;
mod reduce;
mod scene;
mod sightings;
mod tile;

pub use border::Border;
pub use linearise::System;
pub use reduce::{Equations, Reduced};
pub use scene::Scene;
pub use sightings::Sightings;

//! What a step of fitting hands and an object does around the renderer: posing Gaussians, covering pixels by a mesh,
//! comparing images, measuring distances, turning joints, what fingers cost, and how surfaces cover each other. Each is one
//! pass over its data, with its gradient derived by hand where one is taken, for `f32` and `f64` from the same source.
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

mod checks;
pub mod distance;
pub mod fingers;
pub mod groups;
pub mod hand_poses;
pub mod joints;
mod lanes;
mod mat3;
pub mod occlusion;
pub mod outline;
pub mod pixels;
pub mod pose;
pub mod touch;

pub use bigs_raster::RasterError as OpsError;

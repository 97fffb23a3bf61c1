//! Tracks of an object from picture to picture.
//!
//! * Patches of one picture found again in another, to fractions of a pixel: [`cut`] takes them out of their own picture,
//!   [`lay`] moves them over another one to where they fit best.
//! * Bundle adjustment: [`Sightings`] of points in many frames make the normal equations of the object's poses and points
//!   at a [`Scene`], eliminate the points, and say how these follow.
//!
//! A patch is a square of samples about its middle. Places are in pixels of the picture, column first; the first pixel's
//! middle is at (0.5, 0.5), and beyond the border the border goes on.
//!
//! Work is shared among rayon's threads in pieces that do not depend on their number, and sums have a fixed order, so the
//! number of threads changes no bit. Nothing panics on values: a patch at a place that is no number fits nowhere, and a
//! point whose equations have no solution keeps its place.

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

mod bundle;
mod cut;
mod error;
mod lay;
mod picture;
mod sums;

pub use bundle::{Border, Equations, Reduced, Scene, Sightings, System};
pub use cut::{Cut, Templates, cut};
pub use error::TrackError;
pub use lay::{Laid, Laying, lay};
pub use picture::Picture;

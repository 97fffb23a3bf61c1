//! Differentiable 3D Gaussian splatting on the CPU.
//!
//! Gaussians in, images out, and exact gradients back: `f32` and `f64` from the same source, any number of colour
//! channels, alpha and depth, the same bits for any number of threads.
//!
//! ```
//! use bigs_raster::{Camera, Gaussians, Intrinsics, RasterSettings, RenderMode, Renderer};
//!
//! // One red Gaussian, 5 cm wide, 1 m in front of the camera.
//! let gaussians = Gaussians::new(
//!     &[[0.0, 0.0, 1.0]],
//!     &[[1.0, 0.0, 0.0, 0.0]],
//!     &[[0.05, 0.05, 0.05]],
//!     &[0.9],
//!     &[1.0, 0.0, 0.0],
//!     3,
//! )?;
//! let world_from_camera_is_identity = [
//!     [1.0, 0.0, 0.0, 0.0],
//!     [0.0, 1.0, 0.0, 0.0],
//!     [0.0, 0.0, 1.0, 0.0],
//!     [0.0, 0.0, 0.0, 1.0],
//! ];
//! let k = Intrinsics { fx: 60.0, fy: 60.0, cx: 16.5, cy: 16.5 };
//! let camera = Camera::new(world_from_camera_is_identity, k, 33, 33)?;
//!
//! let renderer = Renderer::<f32>::new(&RasterSettings::default(), RenderMode::Rgb)?;
//! let frame = renderer.render(&gaussians, &camera, None)?;
//! let centre = &frame.colors[(16 * 33 + 16) * 3..][..3];
//! assert!((centre[0] - 0.9).abs() < 1e-6 && centre[1] == 0.0);
//!
//! // The loss is the red of all pixels; a wider Gaussian is a redder image.
//! let v_colors: Vec<f32> = (0..33 * 33).flat_map(|_| [1.0, 0.0, 0.0]).collect();
//! let grads = renderer.render_vjp(&gaussians, &camera, None, &frame, &v_colors, &vec![0.0; 33 * 33])?;
//! assert!(grads.scales[0][0] > 0.0 && grads.opacities[0] > 0.0);
//! # Ok::<(), bigs_raster::RasterError>(())
//! ```
//!
//! The stages are modules: project, sort, bin into tiles, composite. [`Batch`] renders many views that share some of
//! their inputs; [`Renderer`] renders one. Threads are rayon's: `RAYON_NUM_THREADS` or an installed pool.

#![deny(unsafe_code)]

mod batch;
mod camera;
mod composite;
mod cov;
mod dispatch;
mod error;
mod gaussians;
mod kernel;
pub mod peak;
mod project;
mod real;
mod render;
mod settings;
mod sort;
pub mod stages;
mod tiles;

pub use batch::{
    Batch, BatchGradients, BatchImages, BatchInputs, BatchShape, BatchState, Counters, Slabs, Wanted,
};
pub use camera::{Camera, CameraModel, Intrinsics};
pub use error::RasterError;
pub use gaussians::Gaussians;
pub use real::{Arithmetic, Real};
pub use render::{Frame, GaussianGrads, Renderer};
pub use settings::{RasterSettings, RenderMode};
pub use sort::{RadixKey, radix_sort};

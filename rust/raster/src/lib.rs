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
//! // A camera at the origin that looks along z. Rows of the world-to-camera matrix: here, the identity.
//! let viewmat = [
//!     [1.0, 0.0, 0.0, 0.0],
//!     [0.0, 1.0, 0.0, 0.0],
//!     [0.0, 0.0, 1.0, 0.0],
//!     [0.0, 0.0, 0.0, 1.0],
//! ];
//! let k = Intrinsics { fx: 60.0, fy: 60.0, cx: 16.5, cy: 16.5 };
//! let camera = Camera::new(viewmat, k, 33, 33)?;
//!
//! let renderer = Renderer::<f32>::new(&RasterSettings::default(), RenderMode::Rgb)?;
//! let frame = renderer.render(&gaussians, &camera, None)?;
//! let centre = &frame.colors[(16 * 33 + 16) * 3..][..3];
//! assert!((centre[0] - 0.9).abs() < 1e-6 && centre[1] == 0.0);
//!
//! // The loss is the red of all pixels; a wider Gaussian is a redder image.
//! let v_colors: Vec<f32> = (0..33 * 33).flat_map(|_| [1.0, 0.0, 0.0]).collect();
//! let grads = frame.vjp(&gaussians, &v_colors, &vec![0.0; 33 * 33])?;
//! assert!(grads.scales[0][0] > 0.0 && grads.opacities[0] > 0.0);
//! # Ok::<(), bigs_raster::RasterError>(())
//! ```
//!
//! # Gradients
//!
//! [`Frame::vjp`] takes the gradients of a loss with respect to the frame's colours and alphas, and the Gaussians that the
//! frame shows; it returns the gradients with respect to every input of [`Renderer::render`] ([`GaussianGrads`]). They
//! are those of the formulas: a pair of pixel and Gaussian that is clamped, below the alpha threshold or behind the
//! point where a pixel stops passes none. `examples/fit_image.rs` is a whole optimisation.
//!
//! `means2d` are the gradients of the centres on screen that densification strategies read, already contained in the
//! others; [`Renderer::with_absgrad`] adds their absolute form.
//!
//! # Beyond plain colours and pinholes
//!
//! [`Camera::with_model`] makes a camera orthographic. [`Frame::median_ids`] names the Gaussian at each pixel's median
//! depth. [`RasterSettings::antialiased`] keeps thin Gaussians from growing brighter.
//!
//! # glam
//!
//! Arrays are this crate's language; [`glam`]'s types are spoken at its border. [`Camera::from_affine3`],
//! [`Camera::from_mat4`], [`Camera::look_at`] and [`Camera::orbit`] make cameras, [`Camera::affine3`], [`Camera::mat4`] and
//! [`Camera::eye`] tell of them, and [`OwnedGaussians::from_glam`] copies Gaussians, quaternions of glam's order x y z w
//! into w x y z. For `f64` the types are `DVec3`, `DQuat`, `DMat4` and `DAffine3` ([`GlamTypes`]).
//!
//! # Many views
//!
//! [`Batch`] renders entries × cameras at once. An input may be shared along either axis ([`Broadcast`]): its gradient is
//! then the sum over the views that share it. [`Wanted`] leaves out gradients that nobody needs,
//! [`BatchInputs::pixel_mask`] pixels that nobody looks at.
//!
//! # Threads and reproducibility
//!
//! Threads are rayon's: `RAYON_NUM_THREADS`, or a call inside `ThreadPool::install`. Every sum has a fixed order, so
//! results are the same bits for any number of threads and on every run of one machine. Machines with other vector
//! instructions round differently, in the last bits.
//!
//! # Colours that depend on the direction of view
//!
//! [`Gaussians::with_harmonics`] takes coefficients of spherical harmonics in place of colours. [`Harmonics`] alone turns
//! coefficients into the colours of one or more views, and gradients back.
//!
//! # Memory
//!
//! Scratch memory is kept between calls and shared by all renderers and batches, so that a loop allocates little but its
//! results; [`release_memory`] frees it. A [`Frame`] holds what its backward pass needs until it is dropped.
//!
//! # CPU features
//!
//! Kernels for AVX-512, AVX2 with FMA, NEON and the baseline of the target are compiled in, whatever the flags of the
//! build; the best that the CPU has is picked on first use. [`simd_level`] tells which. The environment variable
//! `BIGS_RASTER_SIMD` lowers the choice to another of [`simd_levels`]; any other name is an error.
//!
//! # Errors
//!
//! What a caller can get wrong is a [`RasterError`] that names the input and what was expected. Arrays are checked once,
//! in [`Gaussians::new`], [`Camera::new`] and [`Batch::new`]; nothing panics on their values. What a [`Frame`] or
//! [`BatchState`] was rendered with it keeps, so that its gradients cannot be asked for with another camera or background.

#![deny(unsafe_code)]
// A caller's mistake is an error, never a panic. Tests may unwrap.
#![cfg_attr(
    not(test),
    warn(
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::todo,
        clippy::unimplemented,
        clippy::undocumented_unsafe_blocks
    )
)]

mod api;
mod backproject;
mod color;
mod composite;
mod error;
mod input;
mod lists;
mod math;
mod memory;
mod pipeline;
mod project;
mod simd;

pub use glam;

pub use api::batch::{Batch, BatchImages, BatchState, Counters};
pub use api::batch_inputs::{BatchGaussians, BatchInputs, BatchShape, Broadcast};
pub use api::batch_vjp::{BatchGradients, Wanted};
pub use api::harmonics::Harmonics;
pub use api::renderer::{Frame, GaussianGrads, Renderer};
#[doc(hidden)]
pub use api::stages;
pub use color::harmonics::HarmonicsGradients;
pub use error::RasterError;
pub use input::camera::{Camera, CameraModel, Intrinsics};
pub use input::gaussians::Gaussians;
pub use input::glam::GlamTypes;
pub use input::owned_gaussians::OwnedGaussians;
pub use input::settings::{RasterSettings, RenderMode};
#[doc(hidden)]
pub use lists::radix_sort::radix_sort;
#[doc(hidden)]
pub use math::radix_key::RadixKey;
pub use math::real::Real;
pub use memory::pool::release_memory;
#[doc(hidden)]
pub use memory::results::filled_with;
pub use pipeline::scalar::Scalar;
#[doc(hidden)]
pub use simd::Vectors;
#[doc(hidden)]
pub use simd::level::{Simd, SimdLevel, Work};
#[doc(hidden)]
pub use simd::peak;
pub use simd::peak::{simd_level, simd_levels};
#[doc(hidden)]
pub use simd::vector::Vector;

/// The README's code is compiled and run with the documentation's.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

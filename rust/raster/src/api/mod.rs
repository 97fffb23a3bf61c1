//! What callers use: single views, batches, harmonics.

pub(crate) mod batch;
pub(crate) mod batch_inputs;
pub(crate) mod batch_vjp;
pub(crate) mod harmonics;
pub(crate) mod renderer;
pub mod stages;

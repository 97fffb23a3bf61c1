//! The gradient of each Gaussian in each tile that it reaches: what the compositor's vjp yields.

use crate::composite::kernel::{ABSOLUTES, LANES, MOMENTS};
use crate::math::real::Real;
use crate::memory::pool::{Buffers, bytes_of, stale};

/// One gradient per intersection, by its number (see [`crate::lists::tile_lists::TileLists::entries`]): those of one
/// Gaussian lie side by side. Each holds `MOMENTS`, then channels, then `ABSOLUTES` if asked for, without gaps.
#[derive(Debug)]
pub(crate) struct IntersectionGradients<T>(Vec<T>);

impl<T> Default for IntersectionGradients<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T: Real> Buffers for IntersectionGradients<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.0)
    }
}

/// Values of one gradient with so many channels.
pub(crate) fn gradient_size(channels: usize, absolute: bool) -> usize {
    MOMENTS + channels + if absolute { ABSOLUTES } else { 0 }
}

impl<T: Real> IntersectionGradients<T> {
    /// This many values, to be written. Enough memory follows that a whole vector can be read from each.
    pub(crate) fn values(&mut self, count: usize) -> &mut [T] {
        &mut stale(&mut self.0, count + LANES)[..count]
    }

    pub(crate) fn written(&self) -> &[T] {
        &self.0
    }
}

//! What the compositor's vjp finds for each pair of tile and Gaussian.

use crate::composite::kernel::{ABSOLUTES, LANES, MOMENTS};
use crate::math::real::Real;
use crate::memory::pool::{Buffers, bytes_of, stale};

/// A slot per entry of [`crate::lists::tile_lists::TileLists::ranks`]: `MOMENTS`, then channels, then `ABSOLUTES` if asked for. Packed:
/// slots are read in another order than they are written, so what counts is how many fit into the caches.
#[derive(Debug)]
pub(crate) struct Slots<T>(Vec<T>);

impl<T> Default for Slots<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T: Real> Buffers for Slots<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.0)
    }
}

/// Values of a slot with so many channels.
pub(crate) fn slot_size(channels: usize, absolute: bool) -> usize {
    MOMENTS + channels + if absolute { ABSOLUTES } else { 0 }
}

impl<T: Real> Slots<T> {
    /// So many values to be written; behind them lie enough others that a whole vector can be read from each.
    pub(crate) fn values(&mut self, count: usize) -> &mut [T] {
        &mut stale(&mut self.0, count + LANES)[..count]
    }

    pub(crate) fn written(&self) -> &[T] {
        &self.0
    }
}

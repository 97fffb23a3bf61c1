//! What the compositor's vjp finds for each pair of tile and Gaussian.

use crate::kernel::{ABSOLUTES, LANES, Lanes, MOMENTS};
use crate::pool::{Buffers, bytes_of, stale};

/// A slot per entry of [`crate::tiles::TileBins::ranks`], in whole cache lines (f32), since slots are read in another
/// order than they are written: `MOMENTS`, then channels, then `ABSOLUTES` if asked for.
#[derive(Debug)]
pub(crate) struct Slots<T>(Vec<Lanes<T>>);

impl<T> Default for Slots<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Buffers for Slots<T>
where
    Self: Send + 'static,
{
    fn bytes(&self) -> usize {
        bytes_of(&self.0)
    }
}

impl<T: Copy + Default> Slots<T>
where
    Lanes<T>: Copy + Default,
{
    /// So many lines to be written.
    pub(crate) fn lines(&mut self, count: usize) -> &mut [Lanes<T>] {
        stale(&mut self.0, count)
    }

    pub(crate) fn written(&self) -> &[Lanes<T>] {
        &self.0
    }
}

/// Lines of a slot with so many channels.
pub(crate) fn slot_width(channels: usize, absolute: bool) -> usize {
    (MOMENTS + channels + if absolute { ABSOLUTES } else { 0 }).div_ceil(LANES)
}

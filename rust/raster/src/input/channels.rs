//! What an image shows of each Gaussian.

use crate::math::real::Real;

/// Channels whose values a splat holds.
pub(crate) const FIRST: usize = 8;

/// Where the values of channels come from: the caller's colours, then camera z.
#[derive(Clone, Copy)]
pub(crate) struct Channels<'a, T> {
    pub(crate) colors: &'a [T],
    /// Values per Gaussian in `colors`.
    pub(crate) stride: usize,
    /// Channels composited: `stride`, 1 more for depth after colours, or 1 for depth alone.
    pub(crate) total: usize,
    /// Channels of `colors` that are composited: all or none.
    pub(crate) colored: usize,
}

impl<T: Real> Channels<'_, T> {
    /// Writes the values of a Gaussian's first channels, as many as its kernels read: channels that there are not are 0.
    #[inline(always)]
    pub(crate) fn write_first(&self, gaussian: usize, depth: T, values: &mut [T; FIRST]) {
        let colors = &self.colors[gaussian * self.stride..][..self.colored];
        if let Ok(&[red, green, blue]) = <&[T; 3]>::try_from(colors) {
            // The usual case, without a loop. Depth is of no meaning if it is no channel.
            let zero = T::ZERO;
            *values = [red, green, blue, depth, zero, zero, zero, zero];
            return;
        }
        *values = [T::ZERO; FIRST];
        for (value, &color) in values.iter_mut().zip(colors) {
            *value = color;
        }
        if self.colored < self.total.min(FIRST) {
            values[self.colored] = depth;
        }
    }
}

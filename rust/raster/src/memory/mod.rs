//! Buffers that are used again, and slices that threads share.

pub(crate) mod pool;
pub(crate) mod shared_slice;

//! Buffers that are used again, arrays that callers get, and slices that threads share.

pub(crate) mod pool;
pub(crate) mod results;
pub(crate) mod shared_slice;

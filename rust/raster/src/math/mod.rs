//! Arithmetic: scalars, covariances.

pub(crate) mod covariance;
pub(crate) mod radix_key;
pub(crate) mod real;

//! What a benchmark asks of the machine.

use pyo3::prelude::*;

/// The CPU feature level the kernels run at: avx512, avx2, neon or baseline.
#[pyfunction]
pub(crate) fn simd_level() -> &'static str {
    bigs_raster::peak::simd_level()
}

/// Measured peak of one thread in 10⁹ float32 operations per second at that level; a multiply-add is two.
#[pyfunction]
pub(crate) fn fma_peak_gflops(py: Python<'_>) -> f64 {
    py.detach(bigs_raster::peak::fma_peak_gflops)
}

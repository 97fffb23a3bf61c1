//! The most multiply-adds a thread can do here, which is what the kernels' times are held against.

use std::hint::black_box;
use std::time::Instant;

use crate::simd::level::SimdLevel;

/// Independent chains of multiply-adds: two units times the latency of four cycles need eight, and with the two
/// constants twelve still fit the sixteen registers of the lower levels.
const CHAINS: usize = 12;
/// Multiply-adds of each chain in one timed run: a few hundred microseconds.
const LENGTH: usize = 1 << 17;
/// Runs, of which the fastest counts: the clock of a core that was idle takes milliseconds to rise.
const RUNS: usize = 40;

/// The CPU feature level the kernels run at, by its name in `BIGS_RASTER_SIMD`.
pub fn simd_level() -> &'static str {
    SimdLevel::detect().name()
}

/// Measured peak of one thread in 10⁹ operations per second, `f32`, at [`simd_level`]; a multiply-add is two.
///
/// The baseline has no fused instruction and does a multiplication and an addition instead. Takes about 20 ms.
pub fn fma_peak_gflops() -> f64 {
    let level = SimdLevel::detect();
    let best = (0..RUNS).map(|_| run(level)).fold(0.0, f64::max);
    best / 1e9
}

/// Operations per second of one run.
fn run(level: SimdLevel) -> f64 {
    let (factor, term) = black_box((0.999_f32, 1e-3_f32));
    let start = Instant::now();
    let (lanes, sum) = chains(level, factor, term);
    black_box(sum);
    (2 * CHAINS * LENGTH * lanes) as f64 / start.elapsed().as_secs_f64()
}

/// The body of every version: `CHAINS` registers, each multiplied by a factor and increased `LENGTH` times. Lane 0 of
/// their sum is returned so that the work cannot be left out.
macro_rules! chains {
    ($lanes:literal, $register:ty, $splat:expr, $multiply_add:expr, $add:expr, $first:expr, $factor:ident, $term:ident) => {{
        let (factor, term) = ($splat($factor), $splat($term));
        let mut sums: [$register; CHAINS] = [term; CHAINS];
        for _ in 0..LENGTH {
            for sum in &mut sums {
                *sum = $multiply_add(*sum, factor, term);
            }
        }
        ($lanes, $first(sums.into_iter().fold(term, $add)))
    }};
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{CHAINS, LENGTH};

    #[target_feature(enable = "avx512f")]
    pub(super) fn avx512(factor: f32, term: f32) -> (usize, f32) {
        chains!(
            16,
            __m512,
            |x| _mm512_set1_ps(x),
            |a, b, c| _mm512_fmadd_ps(a, b, c),
            |a, b| _mm512_add_ps(a, b),
            |a| _mm512_cvtss_f32(a),
            factor,
            term
        )
    }

    #[target_feature(enable = "avx2,fma")]
    pub(super) fn avx2(factor: f32, term: f32) -> (usize, f32) {
        chains!(
            8,
            __m256,
            |x| _mm256_set1_ps(x),
            |a, b, c| _mm256_fmadd_ps(a, b, c),
            |a, b| _mm256_add_ps(a, b),
            |a| _mm256_cvtss_f32(a),
            factor,
            term
        )
    }

    #[target_feature(enable = "sse2")]
    pub(super) fn baseline(factor: f32, term: f32) -> (usize, f32) {
        chains!(
            4,
            __m128,
            |x| _mm_set1_ps(x),
            |a, b, c| _mm_add_ps(_mm_mul_ps(a, b), c),
            |a, b| _mm_add_ps(a, b),
            |a| _mm_cvtss_f32(a),
            factor,
            term
        )
    }
}

#[cfg(target_arch = "aarch64")]
mod arm {
    use std::arch::aarch64::*;

    use super::{CHAINS, LENGTH};

    #[target_feature(enable = "neon")]
    pub(super) fn neon(factor: f32, term: f32) -> (usize, f32) {
        chains!(
            4,
            float32x4_t,
            |x| vdupq_n_f32(x),
            |a, b, c| vfmaq_f32(c, a, b),
            |a, b| vaddq_f32(a, b),
            |a| vgetq_lane_f32::<0>(a),
            factor,
            term
        )
    }
}

/// Lanes of a register, and a number that depends on all the work.
#[allow(unsafe_code)]
fn chains(level: SimdLevel, factor: f32, term: f32) -> (usize, f32) {
    match level {
        // SAFETY: a level other than the baseline comes from `detect`, which has found its features.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx512 => unsafe { x86::avx512(factor, term) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Avx2 => unsafe { x86::avx2(factor, term) },
        // SAFETY: every x86-64 has SSE2.
        #[cfg(target_arch = "x86_64")]
        SimdLevel::Baseline => unsafe { x86::baseline(factor, term) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        SimdLevel::Neon => unsafe { arm::neon(factor, term) },
        #[cfg(not(target_arch = "x86_64"))]
        SimdLevel::Baseline => chains!(
            1,
            f32,
            |x| x,
            |a: f32, b, c| a * b + c,
            |a, b| a + b,
            |a| a,
            factor,
            term
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_level_of_this_machine_has_a_peak() {
        for level in SimdLevel::available() {
            let peak = (0..RUNS).map(|_| run(level)).fold(0.0, f64::max) / 1e9;
            // No thread does 2000 operations per nanosecond; a debug build on a busy machine may do very few.
            assert!(peak > 0.0 && peak < 2000.0, "{}: {peak}", level.name());
        }
    }

    #[test]
    fn chains_compute_what_they_say() {
        // x ← ½x + 1 ends at exactly 2; all chains and the seed of their sum count.
        for level in SimdLevel::available() {
            let (_, sum) = chains(level, 0.5, 1.0);
            assert_eq!(sum, 1.0 + 2.0 * CHAINS as f32, "{}", level.name());
        }
    }
}

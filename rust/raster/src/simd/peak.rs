//! The most multiply-adds a thread can do here, which is what the kernels' times are held against.

use std::hint::black_box;
use std::time::Instant;

use crate::error::RasterError;
use crate::simd::level::{Simd, SimdLevel, Work};
use crate::simd::vector::Vector;

/// Independent chains of multiply-adds: two units times the latency of four cycles need eight, and with the two
/// constants twelve still fit the sixteen registers of the lower levels.
const CHAINS: usize = 12;
/// Multiply-adds of each chain in one timed run: a few hundred microseconds.
const LENGTH: usize = if cfg!(miri) { 64 } else { 1 << 17 };
/// Runs, of which the fastest counts: the clock of a core that was idle takes milliseconds to rise.
const RUNS: usize = 40;

/// The CPU feature level the kernels run at, by its name in `BIGS_RASTER_SIMD`.
///
/// # Errors
/// `BIGS_RASTER_SIMD` names a level that there is not, or that this machine does not have.
pub fn simd_level() -> Result<&'static str, RasterError> {
    SimdLevel::chosen().map(SimdLevel::name)
}

/// The levels of this machine, the best first: what `BIGS_RASTER_SIMD` may name.
pub fn simd_levels() -> Vec<&'static str> {
    SimdLevel::available().into_iter().map(SimdLevel::name).collect()
}

/// Measured peak of one thread in 10⁹ operations per second, `f32`, at [`simd_level`]; a multiply-add is two.
///
/// The baseline of x86-64 has no fused instruction and does a multiplication and an addition instead. Takes about 20 ms.
///
/// # Errors
/// As [`simd_level`].
pub fn fma_peak_gflops() -> Result<f64, RasterError> {
    let level = SimdLevel::chosen()?;
    let best = (0..RUNS).map(|_| run(level)).fold(0.0, f64::max);
    Ok(best / 1e9)
}

/// Operations per second of one run.
fn run(level: SimdLevel) -> f64 {
    let (factor, term) = black_box((0.999_f32, 1e-3_f32));
    let start = Instant::now();
    let (lanes, sum) = level.run(Chains { factor, term });
    black_box(sum);
    (2 * CHAINS * LENGTH * lanes) as f64 / start.elapsed().as_secs_f64()
}

/// `CHAINS` registers, each multiplied by a factor and increased `LENGTH` times.
struct Chains {
    factor: f32,
    term: f32,
}

impl Work for Chains {
    /// Lanes of a register, and the first of the sum of all registers, so that the work cannot be left out.
    type Output = (usize, f32);

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> (usize, f32) {
        let (factor, term) = (S::F32::splat(simd, self.factor), S::F32::splat(simd, self.term));
        let mut registers = [term; CHAINS];
        for _ in 0..LENGTH {
            for register in &mut registers {
                *register = register.times_plus(factor, term);
            }
        }
        let mut sum = term;
        for register in registers {
            sum = sum.plus(register);
        }
        let mut lanes = [0.0; 16];
        sum.store(&mut lanes);
        (S::F32::LANES, lanes[0])
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
            let (_, sum) = level.run(Chains {
                factor: 0.5,
                term: 1.0,
            });
            assert_eq!(sum, 1.0 + 2.0 * CHAINS as f32, "{}", level.name());
        }
    }
}

//! A few seconds of arbitrary inputs; `cargo run --release --example fuzz -- --seconds 120` does minutes of them.

#[path = "support/fuzz.rs"]
mod fuzz;

use std::time::{Duration, Instant};

/// Seeds that once broke something.
const BROKEN_ONCE: [u64; 0] = [];

fn check_seed(seed: u64, pools: &[rayon::ThreadPool]) -> bool {
    let outcome =
        fuzz::check::<f32>(seed, pools).and_then(|seen| Ok(fuzz::check::<f64>(seed, pools)? || seen));
    outcome.unwrap_or_else(|what| panic!("seed {seed}: {what}"))
}

#[test]
fn seeds_that_broke_something() {
    let pools = fuzz::pools();
    for seed in BROKEN_ONCE {
        check_seed(seed, &pools);
    }
}

#[test]
fn arbitrary_inputs_give_an_error_or_finite_results() {
    let pools = fuzz::pools();
    let end = Instant::now() + Duration::from_secs(4);
    let (mut seed, mut images) = (0, 0);
    while Instant::now() < end || seed < 20 {
        images += usize::from(check_seed(seed, &pools));
        seed += 1;
    }
    // Most cases must reach the renderer, or this tests nothing but the checks before it.
    assert!(2 * images > seed as usize, "{images} images of {seed} cases");
}

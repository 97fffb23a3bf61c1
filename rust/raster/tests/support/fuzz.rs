//! Arbitrary and adversarial inputs for the public API, and what must hold for each.
//!
//! Shared by `tests/fuzz.rs` (seconds) and `examples/fuzz.rs` (as long as one likes).
#![allow(dead_code, unreachable_pub)]

mod case;
pub mod dice;

use std::panic::{AssertUnwindSafe, catch_unwind};

use bigs_raster::Scalar;

pub use case::Case;

fn bits<T: Scalar>(values: &[T]) -> Vec<u64> {
    values.iter().map(|v| v.as_f64().to_bits()).collect()
}

/// Renders the case of a seed in every way and says what is wrong with the result; `Ok(true)` if there was an image.
pub fn check<T: Scalar>(seed: u64, pools: &[rayon::ThreadPool]) -> Result<bool, String> {
    let case = Case::<T>::new(seed);
    let render_in = |pool: &rayon::ThreadPool| {
        catch_unwind(AssertUnwindSafe(|| pool.install(|| case.render())))
            .map_err(|panic| format!("panicked: {}", message(panic.as_ref())))
    };
    let first = render_in(&pools[0])?;
    for pool in &pools[1..] {
        let threads = pool.current_num_threads();
        match (&first, &render_in(pool)?) {
            (Ok(one), Ok(many)) => {
                if let Some((array, _)) = one.iter().zip(many).find(|(a, b)| bits(&a.1) != bits(&b.1)) {
                    return Err(format!("{} has other bits with {threads} threads", array.0));
                }
            }
            (Err(one), Err(many)) if one == many => {}
            _ => return Err(format!("{threads} threads give another error")),
        }
    }
    let Ok(arrays) = first else {
        return Ok(false);
    };
    for (name, values) in &arrays {
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            return Err(format!("{name} is {} at {at} ({:?})", values[at], case.wildness));
        }
    }
    let alphas = &arrays[1].1;
    if alphas.iter().any(|&a| !(a >= T::ZERO && a <= T::ONE)) {
        return Err("an alpha outside [0, 1]".into());
    }
    if case.pixel_mask.is_none() {
        let single = catch_unwind(AssertUnwindSafe(|| pools[0].install(|| case.render_first())))
            .map_err(|panic| format!("the single view panicked: {}", message(panic.as_ref())))?;
        match single {
            Ok((image, _)) if bits(&image) == bits(&arrays[0].1[..image.len()]) => {}
            Ok(_) => return Err("the batch has another first image than the single view".into()),
            Err(error) => return Err(format!("only the single view is refused: {error}")),
        }
    }
    Ok(true)
}

fn message(panic: &(dyn std::any::Any + Send)) -> String {
    panic
        .downcast_ref::<String>()
        .cloned()
        .or_else(|| panic.downcast_ref::<&str>().map(ToString::to_string))
        .unwrap_or_default()
}

/// Pools of 1, 2, 3 and 8 threads.
pub fn pools() -> Vec<rayon::ThreadPool> {
    [1, 2, 3, 8]
        .map(|threads| {
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .expect("threads")
        })
        .into()
}

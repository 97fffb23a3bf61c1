//! Hostile calls of the public API, chosen by the fuzzer's bytes: an error or finite numbers, never a panic.
#![no_main]

#[path = "../../raster/tests/support/dice.rs"]
#[allow(dead_code)]
mod dice;
#[path = "../../raster/tests/support/hostile.rs"]
mod hostile;
#[path = "../../raster/tests/support/mod.rs"]
mod support;

use dice::Dice;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Some((call, bytes)) = bytes.split_first() else {
        return;
    };
    let dice = &mut Dice::of_bytes(bytes);
    let outcome = match call % 4 {
        0 => hostile::one_view::<f32>(dice),
        1 => hostile::one_view::<f64>(dice),
        2 => hostile::many_views(dice),
        _ => hostile::harmonics(dice),
    };
    if let Err(what) = outcome {
        panic!("{what}");
    }
});

//! Feeds arbitrary and adversarial inputs to the public API until told to stop, and prints the seed of a failure.
//!
//! ```text
//! cargo run --release -p bigs-raster --example fuzz -- --seconds 120
//! cargo run --release -p bigs-raster --example fuzz -- --seed 4711
//! ```
//!
//! The second prints the case as well. Every case must give a named error or, for any number of threads the same, finite images and finite gradients.

#[path = "../tests/support/fuzz.rs"]
mod fuzz;

use std::process::ExitCode;
use std::time::{Duration, Instant};

use lexopt::prelude::*;

const USAGE: &str = "usage: fuzz [--seconds S] [--first SEED] | fuzz --seed SEED";

fn main() -> ExitCode {
    let (mut seconds, mut seed, mut only) = (60, 1, None);
    let mut parser = lexopt::Parser::from_env();
    let mut parse = || -> Result<(), lexopt::Error> {
        while let Some(argument) = parser.next()? {
            match argument {
                Long("seconds") => seconds = parser.value()?.parse()?,
                Long("first") => seed = parser.value()?.parse()?,
                Long("seed") => only = Some(parser.value()?.parse()?),
                _ => return Err(argument.unexpected()),
            }
        }
        Ok(())
    };
    if let Err(error) = parse() {
        eprintln!("{error}\n{USAGE}");
        return ExitCode::from(2);
    }
    // A panic is caught and reported with its seed; its own message would only repeat that.
    if only.is_none() {
        std::panic::set_hook(Box::new(|_| ()));
    }
    if let Some(seed) = only {
        println!("{:#?}", fuzz::Case::<f64>::new(seed));
    }
    let pools = fuzz::pools();
    let end = Instant::now() + Duration::from_secs(seconds);
    let (mut cases, mut images, mut failures) = (0u64, 0u64, 0u64);
    loop {
        let seed = only.unwrap_or(seed + cases);
        for (scalar, outcome) in [
            ("f32", fuzz::check::<f32>(seed, &pools)),
            ("f64", fuzz::check::<f64>(seed, &pools)),
        ] {
            match outcome {
                Ok(image) => images += u64::from(image),
                Err(what) => {
                    failures += 1;
                    println!("seed {seed}, {scalar}: {what}");
                }
            }
        }
        cases += 1;
        if only.is_some() || Instant::now() >= end {
            break;
        }
    }
    println!("{cases} cases in f32 and f64, {images} of them images, {failures} failures");
    if failures == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

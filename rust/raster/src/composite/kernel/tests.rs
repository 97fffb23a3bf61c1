//! Every instruction set of this machine, and the portable vectors, against double precision: one tile both ways.

use super::*;
use crate::composite::dispatch;
use crate::composite::intersection_gradients::gradient_size;
use crate::input::channels::FIRST;
use crate::input::settings::RasterSettings;
use crate::memory::shared_slice::Scattered;
use crate::simd::Vectors;
use crate::simd::level::{Baseline, SimdLevel};
use crate::simd::portable::Portable;
use crate::simd::vector::FINEST;

const SPLATS: usize = 150;

/// What to run the kernels with.
#[derive(Clone, Copy, Debug)]
enum Runner {
    Level(SimdLevel),
    Portable,
}

impl Runner {
    fn baseline() -> Self {
        Self::Level(SimdLevel::Baseline(Baseline::guaranteed()))
    }
}

fn runners() -> Vec<Runner> {
    let levels = SimdLevel::available().into_iter().map(Runner::Level);
    levels.chain([Runner::Portable]).collect()
}

#[derive(Debug)]
struct Outcome {
    image: Vec<f64>,
    gradients: Vec<f64>,
}

/// Composites 150 splats, half of them faint, into one tile of 4·side pixels and follows a gradient back.
fn run<T: Vectors>(runner: Runner, channels: usize, side: usize) -> Outcome {
    run_with::<T>(runner, channels, side, &RasterSettings::default())
}

fn run_with<T: Vectors>(runner: Runner, channels: usize, side: usize, settings: &RasterSettings) -> Outcome {
    // A seed without a pair so close to the threshold that single precision decides it differently.
    let mut state = 54321u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (state >> 40) as f64 / (1u64 << 24) as f64
    };
    let colors: Vec<T> = (0..SPLATS * channels).map(|_| T::of(uniform())).collect();
    let splats: Vec<Splat<T>> = (0..SPLATS)
        .map(|i| {
            let opacity = if i % 2 == 0 { 0.06 } else { 1.02 * uniform() + 0.01 };
            let (w11, w12, w22) = (0.1 + 0.5 * uniform(), uniform() - 0.5, 0.1 + 0.5 * uniform());
            // Of the outline: {u² + v² ≤ reach}, as it is padded.
            let reach = 1.001 * (opacity.log2() - settings.alpha_threshold.log2()) + 0.01;
            let (slope, extent) = (-w12 / w11, reach.max(0.0).sqrt());
            let half_width = extent * (slope / w22).hypot(1.0 / w11);
            let tilt = -w11 * w12 / (w12 * w12 + w22 * w22);
            let mut values = [T::ZERO; FIRST];
            for (k, value) in values.iter_mut().enumerate().take(channels) {
                *value = colors[i * channels + k];
            }
            Splat {
                x: T::of(64.0 + 36.0 * uniform() - 2.0),
                y: T::of(32.0 + 36.0 * uniform() - 2.0),
                w11: T::of(w11),
                w22: T::of(w22),
                slope: T::of(slope),
                right: T::of(tilt * half_width),
                half_height: T::of(extent / w22),
                log_opacity: T::of(opacity.log2()),
                values,
            }
        })
        .collect();
    // Gradients go in the reverse order of the list.
    let all: Vec<[u32; 2]> = (0..SPLATS as u32).map(|i| [i, SPLATS as u32 - 1 - i]).collect();
    let limits = Limits::new(settings).unwrap();
    let mut task = TileTask {
        origin: (64, 32),
        anchor: super::anchor((64, 32)),
        side,
        entries: &all,
        splats: &splats,
        depths: &[],
        channels: Channels {
            colors: &colors,
            stride: channels,
            total: channels,
            colored: channels,
        },
        first: 0,
        limits: &limits,
    };
    let blocks = side * side;
    let mut open = [0xFFFF; MAX_BLOCKS];
    open[0] = 0xFF0F;
    let mut planes = vec![Lanes::ZERO; channels.next_multiple_of(MAX_CHANNELS) * blocks];
    let mut transmittance = vec![Lanes::ZERO; blocks];
    let mut end = vec![Lanes::ZERO; blocks];
    let mut masks = vec![0; SPLATS];
    let size = gradient_size(channels, false);
    // IntersectionGradients are written, not added to.
    let mut gradients = vec![T::of(f64::NAN); SPLATS * size];
    while task.first < channels {
        let out = TileImage {
            colors: &mut planes[task.first * blocks..],
            transmittance: &mut transmittance,
            end: &mut end,
            masks: &mut masks,
            saturated: &mut 0,
        };
        match runner {
            Runner::Level(level) => dispatch::forward(level, &task, &open, out),
            Runner::Portable => {
                let level = Portable::guaranteed();
                forward_tile::<T::In<Portable>, MAX_CHANNELS, FINEST>(level, &task, &open, out);
            }
        }
        let mut plane = |_| std::array::from_fn(|_| Lanes(std::array::from_fn(|_| T::of(uniform() - 0.5))));
        let v_values: Vec<_> = (0..MAX_CHANNELS).map(&mut plane).collect();
        let v_transmittance = if task.first == 0 {
            plane(0)
        } else {
            [Lanes::ZERO; MAX_BLOCKS]
        };
        let cotangents = TileCotangents {
            transmittance: &transmittance,
            end: &end,
            masks: &masks,
            v_values: &v_values,
            v_transmittance: &v_transmittance,
        };
        let mut scattered = Scattered::new(&mut gradients);
        let out = scattered.all_pieces(size);
        match runner {
            Runner::Level(level) => dispatch::backward(level, &task, &cotangents, out, false),
            Runner::Portable => {
                let level = Portable::guaranteed();
                backward_tile::<T::In<Portable>, MAX_CHANNELS, false, FINEST>(level, &task, &cotangents, out);
            }
        }
        task.first += MAX_CHANNELS;
    }
    let image = planes[..channels * blocks]
        .iter()
        .chain(&transmittance)
        .flat_map(|lanes| &lanes.0);
    Outcome {
        image: image.map(|v| v.as_f64()).collect(),
        gradients: gradients.iter().map(|v| v.as_f64()).collect(),
    }
}

fn relative(a: &[f64], b: &[f64]) -> f64 {
    let difference: f64 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
    (difference / b.iter().map(|b| b * b).sum::<f64>()).sqrt()
}

#[test]
fn every_instruction_set_agrees_with_double_precision() {
    for channels in 1..=8 {
        for side in [1, 2, 4, 8] {
            let exact = run::<f64>(Runner::baseline(), channels, side);
            for runner in runners() {
                if matches!(runner, Runner::Portable) && channels < MAX_CHANNELS {
                    continue;
                }
                let (single, double) = (
                    run::<f32>(runner, channels, side),
                    run::<f64>(runner, channels, side),
                );
                let errors = [
                    (relative(&single.image, &exact.image), 1e-6),
                    (relative(&single.gradients, &exact.gradients), 5e-6),
                    (relative(&double.image, &exact.image), 1e-14),
                    (relative(&double.gradients, &exact.gradients), 1e-13),
                ];
                assert!(
                    errors.iter().all(|(error, limit)| error < limit),
                    "{runner:?}, {channels} channels, side {side}: {errors:?}"
                );
            }
        }
    }
}

#[test]
fn channels_beyond_a_group_add_to_the_moments() {
    for runner in runners() {
        if matches!(runner, Runner::Portable) {
            continue;
        }
        let exact = run::<f64>(Runner::baseline(), 11, 4);
        let single = run::<f32>(runner, 11, 4);
        assert!(relative(&single.image, &exact.image) < 1e-6);
        assert!(relative(&single.gradients, &exact.gradients) < 5e-6, "{runner:?}");
    }
}

#[test]
fn rough_exponentials_are_as_rough_as_their_degree() {
    for level in SimdLevel::available() {
        for channels in [1, 3, 5] {
            let exact = run::<f64>(Runner::baseline(), channels, 4);
            let errors = [3, 4, 5].map(|exp_degree| {
                let settings = RasterSettings {
                    exp_degree,
                    ..RasterSettings::default()
                };
                let rough = run_with::<f32>(Runner::Level(level), channels, 4, &settings);
                [
                    relative(&rough.image, &exact.image),
                    relative(&rough.gradients, &exact.gradients),
                ]
            });
            for (error, limits) in errors.as_flattened().iter().zip([
                1e-5..2e-4,
                1e-5..1e-3,
                3e-7..6e-6,
                3e-7..3e-5,
                0.0..1e-6,
                0.0..5e-6,
            ]) {
                assert!(
                    limits.contains(error),
                    "{level:?}, {channels} channels: {errors:?}"
                );
            }
        }
    }
}

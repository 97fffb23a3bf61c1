//! One benchmark per stage and one for the whole, on a scene like a hand with an object: `cargo bench`.
//!
//! Set `RAYON_NUM_THREADS=1` to compare kernels rather than machines.

use std::hint::black_box;

use bigs_raster::{Camera, Gaussians, Intrinsics, RasterSettings, RenderMode, Renderer, radix_sort, stages};
use criterion::{BatchSize, Criterion, criterion_group, criterion_main};

const SIZE: usize = 256;
const COUNT: usize = 10_000;

struct Splats {
    means: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    opacities: Vec<f32>,
    colors: Vec<f32>,
}

/// 2 mm splats on three ellipsoids that touch, half a metre away, in an order unrelated to their place.
fn hand_and_object() -> Splats {
    let mut state = 0x2545_F491_4F6C_DD1Du64;
    let mut uniform = || {
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        (state.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 40) as f32 / (1u32 << 24) as f32
    };
    let parts = [
        ([0.0, 0.0, 0.0], [0.07, 0.06, 0.065]),
        ([0.085, 0.03, -0.045], [0.045, 0.03, 0.06]),
        ([0.035, -0.02, -0.105], [0.014, 0.055, 0.014]),
    ];
    let mut splats = Splats {
        means: vec![],
        quats: vec![],
        scales: vec![],
        opacities: vec![],
        colors: vec![],
    };
    for _ in 0..COUNT {
        let pick = uniform();
        let (centre, radii) = parts[usize::from(pick > 0.6) + usize::from(pick > 0.85)];
        let (azimuth, height) = (uniform() * std::f32::consts::TAU, 2.0 * uniform() - 1.0);
        let flat = (1.0 - height * height).sqrt();
        let direction = [flat * azimuth.cos(), flat * azimuth.sin(), height];
        splats
            .means
            .push(std::array::from_fn(|i| centre[i] + radii[i] * direction[i]));
        splats.quats.push(std::array::from_fn(|_| uniform() - 0.5));
        splats.scales.push([0.002; 3]);
        splats.opacities.push(0.5 + 0.5 * uniform());
        splats.colors.extend([uniform(), uniform(), uniform()]);
    }
    splats
}

fn camera() -> Camera<f32> {
    let viewmat = [
        [1.0, 0.0, 0.0, -0.02],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.5],
        [0.0, 0.0, 0.0, 1.0],
    ];
    let f = 1.2 * SIZE as f32;
    let centre = SIZE as f32 / 2.0;
    Camera::new(
        viewmat,
        Intrinsics {
            fx: f,
            fy: f,
            cx: centre,
            cy: centre,
        },
        SIZE,
        SIZE,
    )
    .expect("a camera")
}

fn benchmarks(c: &mut Criterion) {
    let s = hand_and_object();
    let gaussians =
        Gaussians::new(&s.means, &s.quats, &s.scales, &s.opacities, &s.colors, 3).expect("splats");
    let (camera, settings) = (camera(), RasterSettings::default());
    let renderer = Renderer::new(&settings, RenderMode::Rgb).expect("settings");

    let keys: Vec<(u32, u32)> = s.means.iter().map(|m| (0.5 + m[2]).to_bits()).zip(0..).collect();
    c.bench_function("sort", |b| {
        b.iter_batched(
            || keys.clone(),
            |mut pairs| radix_sort(black_box(&mut pairs)),
            BatchSize::LargeInput,
        );
    });

    let mut stages = stages::Stages::new(&gaussians, &camera, &settings, RenderMode::Rgb).expect("settings");
    c.bench_function("project", |b| b.iter(|| stages.project()));
    c.bench_function("bin", |b| b.iter(|| stages.bin()));
    c.bench_function("composite", |b| b.iter(|| stages.composite()));

    let frame = renderer.render(&gaussians, &camera, None).expect("a frame");
    let v_colors: Vec<f32> = (0..frame.colors.len()).map(|i| (i % 7) as f32 - 3.0).collect();
    let v_alphas = vec![0.0; frame.alphas.len()];
    c.bench_function("forward", |b| {
        b.iter(|| renderer.render(&gaussians, &camera, None))
    });
    c.bench_function("backward", |b| {
        b.iter(|| renderer.render_vjp(&gaussians, &camera, None, &frame, &v_colors, &v_alphas));
    });
}

criterion_group!(stages_and_whole, benchmarks);
criterion_main!(stages_and_whole);

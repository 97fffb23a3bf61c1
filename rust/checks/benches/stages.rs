//! One benchmark per stage and one for the whole, on four scenes: `cargo bench`, about two minutes.
//!
//! Throughput counts Gaussians where a stage goes through Gaussians, and composited (pixel, Gaussian) pairs where it
//! goes through pixels. `cargo bench -- C/backward` runs a part. Set `RAYON_NUM_THREADS=1` to compare kernels rather
//! than machines, and `BIGS_RASTER_SIMD` to compare instruction sets.

mod support;

use std::hint::black_box;
use std::time::Duration;

use bigs_raster::{RasterSettings, RenderMode, Renderer, radix_sort, stages::Stages};
use criterion::measurement::WallTime;
use criterion::{BatchSize, BenchmarkGroup, Criterion, Throughput, criterion_group, criterion_main};
use support::Workload;

/// Times one stage of one scene; `elements` is what its throughput counts.
fn time<R>(
    group: &mut BenchmarkGroup<'_, WallTime>,
    name: &str,
    elements: usize,
    mut stage: impl FnMut() -> R,
) {
    group.throughput(Throughput::Elements(elements as u64));
    group.bench_function(name, |b| b.iter(|| black_box(stage())));
}

fn benchmark(workload: &Workload, group: &mut BenchmarkGroup<'_, WallTime>) {
    let settings = RasterSettings::default();
    let renderer = Renderer::new(&settings, RenderMode::Rgb).expect("settings");
    let (gaussians, camera) = (workload.gaussians(), workload.camera);
    let n = gaussians.len();
    let frame = renderer.render(&gaussians, &camera, None).expect("a frame");
    let v_colors: Vec<f32> = (0..frame.colors.len()).map(|i| (i % 7) as f32 - 3.0).collect();
    let v_alphas = vec![0.0; frame.alphas.len()];
    let mut stages = Stages::new(&gaussians, &camera, &settings, RenderMode::Rgb).expect("stages");
    let pairs = stages.pairs();
    println!("{}: {n} Gaussians, {pairs} pairs", workload.name);

    let keys: Vec<(u32, u32)> = frame.depths.iter().map(|d| d.to_bits()).zip(0..).collect();
    group.throughput(Throughput::Elements(n as u64));
    group.bench_function("sort", |b| {
        b.iter_batched_ref(|| keys.clone(), radix_sort, BatchSize::LargeInput);
    });
    time(group, "project", n, || stages.project());
    time(group, "bin", n, || stages.bin());
    time(group, "composite", pairs, || stages.composite().len());
    time(group, "composite_vjp", pairs, || {
        stages.composite_vjp(&v_colors, &v_alphas)
    });
    time(group, "project_vjp", n, || stages.project_vjp());
    time(group, "forward", pairs, || {
        renderer.render(&gaussians, &camera, None)
    });
    time(group, "backward", pairs, || {
        frame.vjp(&gaussians, &v_colors, &v_alphas)
    });
}

fn benchmarks(c: &mut Criterion) {
    for workload in Workload::all() {
        let mut group = c.benchmark_group(workload.name);
        benchmark(&workload, &mut group);
        group.finish();
    }
}

criterion_group! {
    name = stages_and_whole;
    config = Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_millis(500))
        .measurement_time(Duration::from_millis(1500));
    targets = benchmarks
}
criterion_main!(stages_and_whole);

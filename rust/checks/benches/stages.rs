//! One benchmark per stage and some for the whole, on four scenes: `cargo bench`, about four minutes. Those of the whole
//! also have a background, one Gaussian more with every call, and one and two threads.
//!
//! Throughput counts Gaussians where a stage goes through Gaussians, and composited (pixel, Gaussian) pairs where it
//! goes through pixels. `cargo bench -- C/backward` runs a part. Set `RAYON_NUM_THREADS=1` to compare kernels rather
//! than machines, and `BIGS_RASTER_SIMD` to compare instruction sets.

mod support;

use std::hint::black_box;
use std::time::Duration;

use bigs_raster::{Gaussians, RasterSettings, RenderMode, Renderer, radix_sort, stages::Stages};
use criterion::measurement::WallTime;
use criterion::{BatchSize, BenchmarkGroup, Criterion, Throughput, criterion_group, criterion_main};
use rayon::ThreadPoolBuilder;
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
    let both = |gaussians: &Gaussians<'_, f32>, background: Option<&[f32]>| {
        let frame = renderer.render(gaussians, &camera, background).expect("a frame");
        frame.vjp(gaussians, &v_colors, &v_alphas)
    };
    time(group, "both", pairs, || both(&gaussians, None));
    time(group, "both, background", pairs, || {
        both(&gaussians, Some(&[0.2, 0.5, 0.7]))
    });
    // One Gaussian more with every call, as in a fit that adds some: no buffer is ever of the last call's size.
    let mut count = n - n / 8;
    time(group, "both, growing", pairs, || {
        count = if count == n { n - n / 8 } else { count + 1 };
        both(&workload.first(count), None)
    });
    let fewer = workload.first(n - n / 16);
    time(group, "both, as many as growing", pairs, || both(&fewer, None));
    for threads in [1, 2] {
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads");
        let name = format!("both, threads: {threads}");
        time(group, &name, pairs, || pool.install(|| both(&gaussians, None)));
    }
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

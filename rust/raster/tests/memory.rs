//! Renders in a loop allocate what they return and hardly more; what older renders left in the buffers is never seen.

// An allocator that counts is unsafe to write; it passes everything on.
#![allow(unsafe_code)]

mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

use bigs_raster::{Frame, GaussianGrads, RasterSettings, RenderMode, Renderer, release_memory};
use support::{Scene, VIEWMAT, camera};

struct Counting;
static ALLOCATED: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATED.fetch_add(layout.size(), Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// One test at a time: they share the counter and the pool.
static ALONE: Mutex<()> = Mutex::new(());

fn render(n: usize, size: usize, mode: RenderMode) -> (Frame<f32>, GaussianGrads<f32>) {
    let scene = Scene::<f32>::random(n, 3, 5);
    let camera = camera(VIEWMAT, size, size);
    let renderer = Renderer::new(&RasterSettings::default(), mode).unwrap();
    render_scene(&renderer, &scene, &camera)
}

fn render_scene(
    renderer: &Renderer<f32>,
    scene: &Scene<f32>,
    camera: &bigs_raster::Camera<f32>,
) -> (Frame<f32>, GaussianGrads<f32>) {
    let frame = renderer.render(&scene.view(), camera, None).unwrap();
    // The upper half of the image has no gradient, so some tiles are skipped.
    let half = frame.alphas.len() / 2;
    let v_colors: Vec<f32> = (0..frame.colors.len())
        .map(|i| f32::from(u8::from(i > frame.colors.len() / 2)))
        .collect();
    let v_alphas: Vec<f32> = (0..frame.alphas.len())
        .map(|i| f32::from(u8::from(i > half)))
        .collect();
    let grads = frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap();
    (frame, grads)
}

#[test]
fn a_loop_allocates_what_it_returns() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let (n, size) = (5000, 256);
    let scene = Scene::<f32>::random(n, 3, 5);
    let camera = camera(VIEWMAT, size, size);
    let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb).unwrap();
    for _ in 0..2 {
        render_scene(&renderer, &scene, &camera);
    }
    let before = ALLOCATED.load(Relaxed);
    render_scene(&renderer, &scene, &camera);
    let allocated = ALLOCATED.load(Relaxed) - before;
    // Colours and alphas with their gradients; of each Gaussian what is told, and 16 gradients.
    let returned = 4 * (size * size * 2 * 4 + n * (5 + 16));
    // Each piece of parallel work has a few kilobytes of its own; the scratch alone is three times what is returned.
    assert!(
        allocated < returned + returned / 4,
        "{allocated} bytes allocated, {returned} returned"
    );
}

#[test]
fn old_buffers_leave_no_trace() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let calls = [
        (3000, 150, RenderMode::RgbExpectedDepth),
        (40, 33, RenderMode::Rgb),
        (700, 97, RenderMode::RgbDepth),
        (0, 20, RenderMode::Rgb),
        (300, 16, RenderMode::ExpectedDepth),
    ];
    let fresh = calls.map(|(n, size, mode)| {
        release_memory();
        render(n, size, mode)
    });
    release_memory();
    for _ in 0..2 {
        for ((n, size, mode), (frame, grads)) in calls.iter().zip(&fresh) {
            let (again, grads_again) = render(*n, *size, *mode);
            assert!(frame.colors == again.colors && frame.alphas == again.alphas);
            assert!(frame.means2d == again.means2d && frame.radii == again.radii);
            assert!(*grads == grads_again, "{n} Gaussians, {size} pixels");
        }
    }
}

//! The engine against a naive renderer and against finite differences of itself.

mod support;

use bigs_raster::{Camera, CameraModel, GaussianGrads, Intrinsics, RasterSettings, RenderMode, Renderer};
use support::{Random, Scene, VIEWMAT, camera, naive, naive_with, relative};

#[test]
fn images_match_the_naive_renderer() {
    for (n, channels, width, height, seed) in [
        (1, 3, 20, 20, 1),
        (40, 3, 33, 17, 2),
        (200, 4, 64, 48, 3),
        (100, 11, 40, 41, 4),
        (30, 1, 5, 90, 5),
    ] {
        for settings in [
            RasterSettings::default(),
            RasterSettings {
                tile_size: 4,
                ..Default::default()
            },
            RasterSettings {
                alpha_threshold: 0.0,
                min_transmittance: 0.0,
                ..Default::default()
            },
            RasterSettings {
                max_alpha: 0.6,
                eps2d: 0.1,
                ..Default::default()
            },
        ] {
            let scene = Scene::<f64>::random(n, channels, seed);
            let (colors, alphas) = naive(&scene, VIEWMAT, width, height, &settings);
            let renderer = Renderer::new(&settings, RenderMode::Rgb).unwrap();
            let frame = renderer
                .render(&scene.view(), &camera(VIEWMAT, width, height), None)
                .unwrap();
            assert!(relative(&frame.colors, &colors) < 1e-12);
            assert!(relative(&frame.alphas, &alphas) < 1e-12);
        }
    }
}

#[test]
fn orthographic_images_match_the_naive_renderer() {
    let scene = Scene::<f64>::random(200, 3, 9);
    let settings = RasterSettings::default();
    let model = CameraModel::Orthographic;
    let (colors, alphas) = naive_with(model, &scene, VIEWMAT, 64, 48, &settings);
    let camera = camera(VIEWMAT, 64, 48).with_model(model);
    let renderer = Renderer::new(&settings, RenderMode::Rgb).unwrap();
    let frame = renderer.render(&scene.view(), &camera, None).unwrap();
    assert!(relative(&frame.colors, &colors) < 1e-12);
    assert!(relative(&frame.alphas, &alphas) < 1e-12);
}

#[test]
fn single_precision_stays_close() {
    let double = Scene::<f64>::random(200, 3, 7);
    let single = Scene::<f32>::random(200, 3, 7);
    let (colors, alphas) = naive(&double, VIEWMAT, 64, 48, &RasterSettings::default());
    let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb).unwrap();
    let frame = renderer
        .render(&single.view(), &camera(VIEWMAT, 64, 48), None)
        .unwrap();
    assert!(relative(&frame.colors, &colors) < 2e-6);
    assert!(relative(&frame.alphas, &alphas) < 2e-6);
}

#[test]
fn depth_is_a_channel() {
    let scene = Scene::<f64>::random(60, 3, 8);
    let camera = camera(VIEWMAT, 40, 30);
    let settings = RasterSettings::default();
    let render = |mode| {
        Renderer::new(&settings, mode)
            .unwrap()
            .render(&scene.view(), &camera, None)
            .unwrap()
    };
    let both = render(RenderMode::RgbDepth);
    let mut painted = scene.clone();
    for (id, color) in painted.colors.chunks_exact_mut(3).enumerate() {
        color[0] = both.depths[id];
    }
    let painted = Renderer::new(&settings, RenderMode::Rgb)
        .unwrap()
        .render(&painted.view(), &camera, None)
        .unwrap();
    let alone = render(RenderMode::Depth);
    let expected = render(RenderMode::ExpectedDepth);
    for pixel in 0..40 * 30 {
        let depth = both.colors[pixel * 4 + 3];
        assert_eq!(depth, painted.colors[pixel * 3]);
        assert_eq!(depth, alone.colors[pixel]);
        let alpha = both.alphas[pixel];
        assert!((expected.colors[pixel] * alpha - depth).abs() < 1e-12);
    }
}

/// A scene, a camera and a background as one flat vector, so that every entry can be moved.
fn perturbed(
    scene: &Scene<f64>,
    viewmat: [[f64; 4]; 4],
    background: [f64; 3],
    at: usize,
    h: f64,
) -> (Scene<f64>, [[f64; 4]; 4], [f64; 3]) {
    let (mut scene, mut viewmat, mut background) = (scene.clone(), viewmat, background);
    let mut entries: Vec<&mut f64> = scene
        .means
        .as_flattened_mut()
        .iter_mut()
        .chain(scene.quats.as_flattened_mut())
        .chain(scene.scales.as_flattened_mut())
        .chain(&mut scene.opacities)
        .chain(&mut scene.colors)
        .chain(viewmat.as_flattened_mut()[..12].iter_mut())
        .chain(&mut background)
        .collect();
    *entries[at] += h;
    (scene, viewmat, background)
}

fn flat(grads: &GaussianGrads<f64>) -> Vec<f64> {
    let parts = [
        grads.means.as_flattened(),
        grads.quats.as_flattened(),
        grads.scales.as_flattened(),
        &grads.opacities,
        &grads.colors,
        grads.viewmat.as_flattened(),
        &grads.background,
    ];
    parts.concat()
}

#[test]
fn gradients_are_finite_differences() {
    let (pinhole, ortho) = (CameraModel::Pinhole, CameraModel::Orthographic);
    for (mode, antialiased, model) in [
        (RenderMode::Rgb, false, pinhole),
        (RenderMode::RgbDepth, true, pinhole),
        (RenderMode::RgbExpectedDepth, false, pinhole),
        (RenderMode::Rgb, false, ortho),
        (RenderMode::RgbDepth, true, ortho),
    ] {
        // Away from cliffs: every pair counts and no pixel stops.
        let settings = RasterSettings {
            alpha_threshold: 0.0,
            min_transmittance: 0.0,
            antialiased,
            ..Default::default()
        };
        let (width, height) = (19, 13);
        let mut scene = Scene::<f64>::random(5, 3, 11);
        if mode.expects_depth() {
            // Wide enough that alpha is nowhere near the 1e-10 below which expected depth is no quotient.
            scene.scales.as_flattened_mut().iter_mut().for_each(|s| *s *= 4.0);
        }
        let background = [0.3, 0.9, 0.1];
        let renderer = Renderer::<f64>::new(&settings, mode).unwrap();
        let mut r = Random::new(3);
        let channels = if mode.has_depth() { 4 } else { 3 };
        let v_colors: Vec<f64> = (0..width * height * channels)
            .map(|_| r.uniform(-1.0, 1.0))
            .collect();
        let v_alphas: Vec<f64> = (0..width * height).map(|_| r.uniform(-1.0, 1.0)).collect();
        let loss = |scene: &Scene<f64>, viewmat, background: [f64; 3]| {
            let camera: Camera<f64> = camera(viewmat, width, height).with_model(model);
            let frame = renderer
                .render(&scene.view(), &camera, Some(&background))
                .unwrap();
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            dot(&frame.colors, &v_colors) + dot(&frame.alphas, &v_alphas)
        };
        let camera = camera(VIEWMAT, width, height).with_model(model);
        let frame = renderer
            .render(&scene.view(), &camera, Some(&background))
            .unwrap();
        let grads = frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap();
        let grads = flat(&grads);
        let h = 1e-5;
        for (at, &gradient) in grads.iter().enumerate() {
            let value = |h| {
                let (scene, viewmat, background) = perturbed(&scene, VIEWMAT, background, at, h);
                loss(&scene, viewmat, background)
            };
            let difference = (value(h) - value(-h)) / (2.0 * h);
            let scale = 1.0 + difference.abs();
            assert!(
                (gradient - difference).abs() < 1e-5 * scale,
                "{mode:?} {at}: {gradient} {difference}"
            );
        }
    }
}

/// Runs this file's other tests again with the kernels of lesser CPUs.
#[test]
fn every_cpu_level_passes() {
    for level in bigs_raster::simd_levels() {
        let run = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["images_match", "single_precision", "depth_is", "gradients_are"])
            .env("BIGS_RASTER_SIMD", level)
            .output()
            .unwrap();
        assert!(
            run.status.success(),
            "{level}: {}",
            String::from_utf8_lossy(&run.stdout)
        );
    }
}

#[test]
fn gradients_on_screen_are_those_of_moving_the_image() {
    // Moving the principal point moves every centre and changes nothing else while no slope is limited.
    let (width, height) = (24, 20);
    let settings = RasterSettings {
        alpha_threshold: 0.0,
        min_transmittance: 0.0,
        ..Default::default()
    };
    let mut scene = Scene::<f64>::random(1, 3, 31);
    scene.means[0] = [0.05, -0.1, 1.2];
    let renderer = Renderer::<f64>::new(&settings, RenderMode::Rgb).unwrap();
    let mut r = Random::new(4);
    let v_colors: Vec<f64> = (0..width * height * 3).map(|_| r.uniform(-1.0, 1.0)).collect();
    let v_alphas = vec![0.0; width * height];
    let shifted = |shift: [f64; 2]| {
        let [fx, fy, cx, cy] = support::intrinsics(width, height);
        let k = Intrinsics {
            fx,
            fy,
            cx: cx + shift[0],
            cy: cy + shift[1],
        };
        Camera::new(VIEWMAT, k, width, height).unwrap()
    };
    let loss = |shift| {
        let frame = renderer.render(&scene.view(), &shifted(shift), None).unwrap();
        frame
            .colors
            .iter()
            .zip(&v_colors)
            .map(|(a, b)| a * b)
            .sum::<f64>()
    };
    let camera = shifted([0.0; 2]);
    let frame = renderer.render(&scene.view(), &camera, None).unwrap();
    let grads = frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap();
    let h = 1e-5;
    for (axis, step) in [(0, [h, 0.0]), (1, [0.0, h])] {
        let expected = (loss(step) - loss(step.map(|s: f64| -s))) / (2.0 * h);
        assert!((grads.means2d[0][axis] - expected).abs() < 1e-6 * (1.0 + expected.abs()));
        assert!(expected.abs() > 1e-3);
    }
}

#[test]
fn absolute_gradients_are_those_of_single_pixels() {
    let (width, height) = (13, 11);
    let scene = Scene::<f64>::random(30, 3, 41);
    let camera = camera(VIEWMAT, width, height);
    let renderer = Renderer::<f64>::new(&RasterSettings::default(), RenderMode::Rgb)
        .unwrap()
        .with_absgrad();
    let frame = renderer.render(&scene.view(), &camera, None).unwrap();
    let mut r = Random::new(5);
    let v_colors: Vec<f64> = (0..width * height * 3).map(|_| r.uniform(-1.0, 1.0)).collect();
    let v_alphas = vec![0.0; width * height];
    let gradients = |v_colors: &[f64]| frame.vjp(&scene.view(), v_colors, &v_alphas).unwrap();
    let mut sums = vec![0.0; 2 * 30];
    for pixel in 0..width * height {
        let mut alone = vec![0.0; v_colors.len()];
        alone[3 * pixel..3 * pixel + 3].copy_from_slice(&v_colors[3 * pixel..3 * pixel + 3]);
        let grads = gradients(&alone);
        for (sum, v) in sums.iter_mut().zip(grads.means2d.as_flattened()) {
            *sum += v.abs();
        }
    }
    let together = gradients(&v_colors);
    assert!(relative(together.absgrad.as_flattened(), &sums) < 1e-12);
    let plain = Renderer::<f64>::new(&RasterSettings::default(), RenderMode::Rgb).unwrap();
    let frame = plain.render(&scene.view(), &camera, None).unwrap();
    let without = frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap();
    assert!(without.absgrad.is_empty());
    assert!(relative(together.means.as_flattened(), without.means.as_flattened()) < 1e-12);
}

#[test]
fn the_median_is_where_half_the_light_is_gone() {
    // Three walls; before each of them there is light 1, 0.6, 0.42.
    let mut scene = Scene::<f32>::random(3, 3, 1);
    scene.means = vec![[0.0, 0.0, 3.0], [0.0, 0.0, 1.0], [0.0, 0.0, 2.0]];
    scene.scales = vec![[1e3; 3]; 3];
    let medians = |opacities: [f32; 3]| {
        let mut scene = scene.clone();
        scene.opacities = opacities.to_vec();
        let identity = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(i == j)));
        let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb).unwrap();
        let frame = renderer
            .render(&scene.view(), &camera(identity, 9, 7), None)
            .unwrap();
        frame.median_ids()
    };
    assert_eq!(medians([0.9, 0.4, 0.3]), [2; 63]);
    assert_eq!(medians([0.9, 0.4, 0.1]), [0; 63]);
    assert_eq!(medians([0.0, 0.0, 0.0]), [-1; 63]);
}

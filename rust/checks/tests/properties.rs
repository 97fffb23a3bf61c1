//! What holds for every scene, and the same bits for any number of threads.

#[path = "../../raster/tests/support/fuzz.rs"]
mod fuzz;
#[path = "../../raster/tests/support/mod.rs"]
mod support;

use bigs_raster::{
    Batch, BatchGaussians, BatchInputs, BatchShape, Broadcast, CameraModel, GaussianGrads, RasterSettings,
    RenderMode, Renderer, Scalar, Wanted,
};
use proptest::prelude::*;
use support::{Random, Scene, VIEWMAT, camera, intrinsics, naive, relative};

const WIDTH: usize = 46;
const HEIGHT: usize = 35;

fn render<T: Scalar>(
    scene: &Scene<T>,
    viewmat: [[f64; 4]; 4],
    settings: &RasterSettings,
    background: Option<&[T]>,
) -> (Vec<T>, Vec<T>, GaussianGrads<T>) {
    let renderer = Renderer::new(settings, RenderMode::Rgb).unwrap();
    let camera = camera(viewmat, WIDTH, HEIGHT);
    let frame = renderer.render(&scene.view(), &camera, background).unwrap();
    let mut r = Random::new(5);
    let mut noise = |count: usize| -> Vec<T> { (0..count).map(|_| T::of(r.uniform(-1.0, 1.0))).collect() };
    let (v_colors, v_alphas) = (noise(frame.colors.len()), noise(frame.alphas.len()));
    let grads = frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap();
    (frame.colors, frame.alphas, grads)
}

fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 8, ..ProptestConfig::default() })]

    #[test]
    fn the_order_of_gaussians_does_not_matter(seed in any::<u32>(), n in 1usize..80) {
        let scene = Scene::<f32>::random(n, 3, u64::from(seed));
        let mut order: Vec<usize> = (0..n).collect();
        let mut dice = fuzz::dice::Dice::new(u64::from(seed));
        for i in (1..n).rev() {
            order.swap(i, dice.below(i + 1));
        }
        let pick = |values: &[[f32; 3]]| order.iter().map(|&i| values[i]).collect::<Vec<_>>();
        let moved = Scene {
            means: pick(&scene.means),
            quats: order.iter().map(|&i| scene.quats[i]).collect(),
            scales: pick(&scene.scales),
            opacities: order.iter().map(|&i| scene.opacities[i]).collect(),
            colors: order.iter().flat_map(|&i| scene.colors[3 * i..3 * i + 3].to_vec()).collect(),
            channels: 3,
        };
        let settings = RasterSettings::default();
        let (colors, alphas, grads) = render(&scene, VIEWMAT, &settings, None);
        let (other_colors, other_alphas, other) = render(&moved, VIEWMAT, &settings, None);
        prop_assert!(colors == other_colors && alphas == other_alphas);
        for (to, &from) in order.iter().enumerate() {
            prop_assert_eq!(grads.means[from], other.means[to]);
            prop_assert_eq!(grads.quats[from], other.quats[to]);
            prop_assert_eq!(grads.scales[from], other.scales[to]);
            prop_assert_eq!(grads.opacities[from], other.opacities[to]);
        }
    }

    #[test]
    fn images_are_linear_in_colors_and_background(seed in any::<u32>(), a in -3.0..3.0f64, b in -3.0..3.0f64) {
        let scene = Scene::<f64>::random(50, 3, u64::from(seed));
        let other = Scene::<f64>::random(50, 3, u64::from(seed) + 1);
        let mix = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| a * x + b * y).collect::<Vec<_>>();
        let image = |colors: &[f64], background: &[f64]| {
            let painted = Scene { colors: colors.to_vec(), ..scene.clone() };
            render(&painted, VIEWMAT, &RasterSettings::default(), Some(background)).0
        };
        let (one, two) = ([0.3, 0.9, 0.1], [0.8, -0.5, 0.2]);
        let mixed = image(&mix(&scene.colors, &other.colors), &mix(&one, &two));
        let parts = mix(&image(&scene.colors, &one), &image(&other.colors, &two));
        prop_assert!(largest_difference(&mixed, &parts) < 1e-12);
    }

    #[test]
    fn moving_world_and_camera_together_changes_nothing(seed in any::<u32>(), angle in -3.0..3.0f64) {
        let scene = Scene::<f64>::random(50, 3, u64::from(seed));
        // A turn about z and a step: x' = Q x + t, and the camera takes it back.
        let (sin, cos) = angle.sin_cos();
        let t = [1.0, -20.0, 3.0];
        let turn = |p: [f64; 3]| [cos * p[0] - sin * p[1], sin * p[0] + cos * p[1], p[2]];
        let mut moved = scene.clone();
        for mean in &mut moved.means {
            let turned = turn(*mean);
            *mean = std::array::from_fn(|i| turned[i] + t[i]);
        }
        let (s, c) = (0.5 * angle).sin_cos();
        for q in &mut moved.quats {
            let [w, x, y, z] = *q;
            *q = [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w];
        }
        let mut viewmat = VIEWMAT;
        for row in &mut viewmat[..3] {
            let turned = turn([row[0], row[1], row[2]]);
            row[..3].copy_from_slice(&turned);
            row[3] -= turned[0] * t[0] + turned[1] * t[1] + turned[2] * t[2];
        }
        let settings = RasterSettings::default();
        let (colors, alphas, grads) = render(&scene, VIEWMAT, &settings, None);
        let (other_colors, other_alphas, other) = render(&moved, viewmat, &settings, None);
        prop_assert!(largest_difference(&colors, &other_colors) < 1e-10);
        prop_assert!(largest_difference(&alphas, &other_alphas) < 1e-10);
        prop_assert!(relative(other.scales.as_flattened(), grads.scales.as_flattened()) < 1e-8);
        let turned: Vec<f64> = grads.means.iter().flat_map(|&v| turn(v)).collect();
        prop_assert!(relative(other.means.as_flattened(), &turned) < 1e-8);
    }

    #[test]
    fn tiles_are_invisible(seed in any::<u32>(), wide in any::<bool>()) {
        let mut scene = Scene::<f32>::random(120, 3, u64::from(seed));
        if wide {
            scene.scales.iter_mut().for_each(|s| s[0] *= 30.0);
        }
        let image = |tile_size| {
            let settings = RasterSettings { tile_size, ..Default::default() };
            render(&scene, VIEWMAT, &settings, None)
        };
        let (colors, alphas, _) = image(32);
        for tile_size in [4, 8, 16] {
            let other = image(tile_size);
            prop_assert!(other.0 == colors && other.1 == alphas);
        }
    }

    #[test]
    fn culling_changes_nothing(seed in any::<u32>(), thin in any::<bool>()) {
        let mut scene = Scene::<f64>::random(80, 3, u64::from(seed));
        if thin {
            scene.scales.iter_mut().for_each(|s| *s = [2.0, 2e-6, 2e-6]);
        }
        let settings = RasterSettings::default();
        let (expected, expected_alphas) = naive(&scene, VIEWMAT, WIDTH, HEIGHT, &settings);
        let (colors, alphas, _) = render(&scene, VIEWMAT, &settings, None);
        // One lost pair would change a pixel by 1/255 of the light that is left there, 4e-7 at least.
        prop_assert!(largest_difference(&colors, &expected) < 1e-9);
        prop_assert!(largest_difference(&alphas, &expected_alphas) < 1e-9);
    }
}

/// Everything a batch returns, as bits.
fn batch_bits<T: Scalar>(threads: usize, mode: RenderMode, channels: usize, masked: bool) -> Vec<u64> {
    let shape = BatchShape {
        entries: 2,
        cameras: 2,
        gaussians: 1200,
        channels,
        width: 90,
        height: 60,
    };
    let scenes = [1, 2].map(|seed| Scene::<T>::random(shape.gaussians, channels, seed));
    let both = |pick: &dyn Fn(&Scene<T>) -> Vec<T>| scenes.iter().flat_map(pick).collect::<Vec<T>>();
    let means = both(&|s| s.means.as_flattened().to_vec());
    let quats = both(&|s| s.quats.as_flattened().to_vec());
    let colors = both(&|s| s.colors.clone());
    let mut viewmats = Vec::new();
    for view in 0..shape.views() {
        let mut viewmat = VIEWMAT;
        viewmat[0][3] += 0.02 * view as f64;
        viewmats.extend(viewmat.as_flattened().iter().map(|&v| T::of(v)));
    }
    let [fx, fy, cx, cy] = intrinsics(shape.width, shape.height);
    let ks = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0].map(T::of);
    let mut r = Random::new(9);
    let mut noise = |count: usize| -> Vec<T> { (0..count).map(|_| T::of(r.uniform(-1.0, 1.0))).collect() };
    let backgrounds = noise(shape.views() * channels);
    let pixels = shape.views() * shape.width * shape.height;
    let (v_colors, v_alphas) = (noise(pixels * shape.image_channels(mode)), noise(pixels));
    let mask: Vec<bool> = (0..pixels).map(|p| p % 7 != 3 && p % 1000 > 200).collect();
    let own = |data| Broadcast {
        data,
        entries: 2,
        cameras: 1,
    };
    let shared = |data| Broadcast {
        data,
        entries: 1,
        cameras: 1,
    };
    let views = |data| Broadcast {
        data,
        entries: 2,
        cameras: 2,
    };
    let inputs = BatchInputs {
        gaussians: BatchGaussians {
            means: own(&means),
            quats: own(&quats),
            scales: shared(scenes[0].scales.as_flattened()),
            opacities: shared(&scenes[0].opacities),
            colors: own(&colors),
        },
        viewmats: views(&viewmats),
        ks: shared(&ks),
        backgrounds: Some(views(&backgrounds)),
        pixel_mask: masked.then_some(Broadcast {
            data: &mask,
            entries: 2,
            cameras: 2,
        }),
        camera_model: CameraModel::Pinhole,
    };
    let all = Wanted {
        means: true,
        quats: true,
        scales: true,
        opacities: true,
        colors: true,
        viewmats: true,
        backgrounds: true,
        means2d: true,
        detach_means2d: false,
        absgrad: true,
    };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap();
    pool.install(|| {
        let batch = Batch::new(shape, inputs, &RasterSettings::default(), mode).unwrap();
        let (images, state) = batch.render().unwrap();
        let v = state
            .vjp(&inputs.gaussians, Some(&v_colors), Some(&v_alphas), all)
            .unwrap();
        let parts = [
            images.colors,
            images.alphas,
            images.means2d.into_flattened(),
            images.depths,
            v.means,
            v.quats,
            v.scales,
            v.opacities,
            v.colors,
            v.viewmats,
            v.backgrounds,
            v.means2d,
            v.absgrad,
        ];
        parts.iter().flatten().map(|x| x.as_f64().to_bits()).collect()
    })
}

#[test]
fn thread_counts_and_repetition_change_no_bit() {
    for (mode, channels, masked) in [
        (RenderMode::Rgb, 3, true),
        (RenderMode::RgbExpectedDepth, 10, false),
        (RenderMode::Depth, 1, true),
    ] {
        let single = batch_bits::<f32>(1, mode, channels, masked);
        for threads in [1, 2, 3, 8] {
            let other = batch_bits::<f32>(threads, mode, channels, masked);
            assert!(single == other, "{mode:?}: {threads} threads");
        }
    }
    let single = batch_bits::<f64>(1, RenderMode::RgbDepth, 3, true);
    assert!(single == batch_bits::<f64>(3, RenderMode::RgbDepth, 3, true));
}

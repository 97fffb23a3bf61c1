//! The same bits for any number of threads; a sort that sorts; inputs that are refused.

#[path = "../../raster/tests/support/mod.rs"]
mod support;

use bigs_raster::{
    Camera, GaussianGrads, Gaussians, Intrinsics, RasterError, RasterSettings, RenderMode, Renderer,
    radix_sort,
};
use proptest::prelude::*;
use support::{Scene, VIEWMAT, camera};

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

fn render_with(threads: usize) -> (Vec<u32>, GaussianGrads<f32>) {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap();
    pool.install(|| {
        let scene = Scene::<f32>::random(3000, 3, 21);
        let camera = camera(VIEWMAT, 150, 110);
        let renderer = Renderer::new(&RasterSettings::default(), RenderMode::RgbDepth).unwrap();
        let frame = renderer.render(&scene.view(), &camera, None).unwrap();
        let v_colors: Vec<f32> = (0..frame.colors.len()).map(|i| (i % 7) as f32 - 3.0).collect();
        let v_alphas: Vec<f32> = (0..frame.alphas.len()).map(|i| (i % 5) as f32 - 2.0).collect();
        let grads = frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap();
        (bits(&frame.colors), grads)
    })
}

#[test]
fn thread_counts_give_the_same_bits() {
    let (image, grads) = render_with(1);
    for threads in [2, 3, 8] {
        let (other, other_grads) = render_with(threads);
        assert!(image == other, "{threads} threads changed the image");
        assert!(grads == other_grads, "{threads} threads changed a gradient");
    }
}

proptest! {
    #[test]
    fn radix_sort_is_a_stable_sort(keys in prop::collection::vec(prop_oneof![any::<u32>(), 0u32..5], 0..3000)) {
        let mut pairs: Vec<(u32, u32)> = keys.iter().copied().zip(0..).collect();
        let mut expected = pairs.clone();
        expected.sort_by_key(|&(key, _)| key);
        radix_sort(&mut pairs);
        prop_assert_eq!(pairs, expected);
    }

    #[test]
    fn radix_sort_sees_all_64_bits(keys in prop::collection::vec(any::<u64>(), 0..500), shift in 0u32..64) {
        let mut pairs: Vec<(u64, u32)> = keys.iter().map(|k| k >> shift).zip(0..).collect();
        let mut expected = pairs.clone();
        expected.sort_by_key(|&(key, _)| key);
        radix_sort(&mut pairs);
        prop_assert_eq!(pairs, expected);
    }
}

#[test]
fn bad_inputs_are_named() {
    let scene = Scene::<f32>::random(4, 3, 1);
    let build = |scene: &Scene<f32>| {
        Gaussians::new(
            &scene.means,
            &scene.quats,
            &scene.scales,
            &scene.opacities,
            &scene.colors,
            3,
        )
        .map(|_| ())
    };
    let mut short = scene.clone();
    short.scales.pop();
    let expected = RasterError::LengthMismatch {
        name: "scales",
        expected: 4,
        got: 3,
    };
    assert_eq!(build(&short), Err(expected));
    let mut poisoned = scene.clone();
    poisoned.quats[2][1] = f32::NAN;
    assert_eq!(
        build(&poisoned),
        Err(RasterError::NotFinite {
            name: "quats",
            index: 9
        })
    );
    assert!(
        build(&poisoned)
            .unwrap_err()
            .to_string()
            .starts_with("quats: expected finite values")
    );

    let k = Intrinsics {
        fx: 10.0f32,
        fy: 10.0,
        cx: 5.0,
        cy: 5.0,
    };
    let good = VIEWMAT.map(|row| row.map(|v| v as f32));
    let refused = |viewmat, k, size| {
        matches!(
            Camera::new(viewmat, k, size, 10),
            Err(RasterError::BadCamera { .. })
        )
    };
    assert!(!refused(good, k, 10));
    assert!(refused([good[0], good[0], good[2], good[3]], k, 10));
    assert!(refused([good[0], good[1], good[2], good[2]], k, 10));
    assert!(refused(good, Intrinsics { fx: 0.0, ..k }, 10));
    assert!(refused(good, k, 0));

    let settings = RasterSettings {
        max_alpha: 1.5,
        ..Default::default()
    };
    let error = Renderer::<f32>::new(&settings, RenderMode::Rgb).unwrap_err();
    assert_eq!(
        error.to_string(),
        "settings.max_alpha: expected a number in (0, 1)"
    );
}

#[test]
fn nothing_to_see_is_the_background() {
    let scene = Scene::<f32>::random(0, 3, 1);
    let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb).unwrap();
    let frame = renderer
        .render(&scene.view(), &camera(VIEWMAT, 7, 5), Some(&[0.25, 0.5, 1.0]))
        .unwrap();
    assert!(
        frame
            .colors
            .chunks_exact(3)
            .all(|pixel| pixel == [0.25, 0.5, 1.0])
    );
    assert!(frame.alphas.iter().all(|&alpha| alpha == 0.0));
    let error = renderer
        .render(&scene.view(), &camera(VIEWMAT, 7, 5), Some(&[0.25]))
        .unwrap_err();
    assert_eq!(
        error,
        RasterError::LengthMismatch {
            name: "backgrounds",
            expected: 3,
            got: 1
        }
    );
}

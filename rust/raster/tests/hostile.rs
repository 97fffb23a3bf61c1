//! Calls that no sane program makes: each ends in an error or in finite numbers, none in a panic.

#[path = "support/dice.rs"]
#[allow(dead_code, unreachable_pub)]
mod dice;
#[path = "support/hostile.rs"]
mod hostile;
mod support;

use std::panic::{AssertUnwindSafe, catch_unwind};

use bigs_raster::{Frame, Gaussians, RasterError, RasterSettings, RenderMode, Renderer, stages::Stages};
use dice::Dice;
use hostile::{ALL, Shared, harmonics, many_views, one_view};
use support::{Scene, VIEWMAT, camera};

fn renderer(mode: RenderMode) -> Renderer<f32> {
    Renderer::new(&RasterSettings::default(), mode).unwrap()
}

fn frame(scene: &Scene<f32>, size: usize) -> Frame<f32> {
    let white = vec![1.0; scene.channels];
    renderer(RenderMode::Rgb)
        .render(&scene.view(), &camera(VIEWMAT, size, size), Some(&white))
        .unwrap()
}

#[test]
fn colours_without_channels_are_refused() {
    let scene = Scene::<f32>::random(4, 0, 1);
    let none = Gaussians::new(
        &scene.means,
        &scene.quats,
        &scene.scales,
        &scene.opacities,
        &[],
        0,
    )
    .unwrap();
    let camera = camera(VIEWMAT, 8, 8);
    let message = "colors: expected at least one channel in a mode with colours, found 0";
    for mode in [
        RenderMode::Rgb,
        RenderMode::RgbDepth,
        RenderMode::RgbExpectedDepth,
    ] {
        let error = renderer(mode).render(&none, &camera, None).unwrap_err();
        assert_eq!(error.to_string(), message);
        let settings = RasterSettings::default();
        assert_eq!(Stages::new(&none, &camera, &settings, mode).unwrap_err(), error);
    }
    // Depth needs no colours.
    let frame = renderer(RenderMode::Depth).render(&none, &camera, None).unwrap();
    let v = frame.vjp(&none, &[1.0; 64], &[0.0; 64]).unwrap();
    assert!(v.colors.is_empty() && v.means.iter().any(|v| v[2] != 0.0));
}

#[test]
fn channels_beyond_numbers_are_refused() {
    for channels in [1 << 58, (1 << 63) + 3, usize::MAX, (1 << 16) + 1] {
        let refused = Gaussians::<f32>::new(&[], &[], &[], &[], &[], channels);
        assert!(
            matches!(refused, Err(RasterError::BadSize { name: "colors", .. })),
            "{channels}"
        );
        let colors = [1.0; 6];
        let two = Gaussians::new(
            &[[0.0; 3]; 2],
            &[[1.0; 4]; 2],
            &[[1.0; 3]; 2],
            &[1.0; 2],
            &colors,
            channels,
        );
        assert!(two.is_err(), "{channels}");
    }
}

#[test]
fn a_frame_takes_only_as_many_gaussians_as_it_shows() {
    let scene = Scene::<f32>::random(20, 3, 1);
    let frame = frame(&scene, 33);
    let (v_colors, v_alphas) = (vec![1.0; 33 * 33 * 3], vec![1.0; 33 * 33]);
    let right = frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap();
    assert!(right.means.iter().flatten().all(|v| v.is_finite()));
    for n in [0, 1, 19, 21, 300, 5000] {
        let other = Scene::<f32>::random(n, 3, 2);
        let error = frame.vjp(&other.view(), &v_colors, &v_alphas).unwrap_err();
        assert_eq!(
            error.to_string(),
            format!("means: expected 20 elements, found {n}")
        );
    }
    for channels in [1, 2, 4, 9] {
        let other = Scene::<f32>::random(20, channels, 2);
        let error = frame.vjp(&other.view(), &v_colors, &v_alphas).unwrap_err();
        assert!(matches!(error, RasterError::BadSize { name: "colors", .. }));
    }
    for (colors, alphas) in [
        (0, 33 * 33),
        (33 * 33 * 3, 0),
        (33 * 33 * 3 - 1, 33 * 33),
        (32 * 33 * 3, 32 * 33),
    ] {
        assert!(
            frame
                .vjp(&scene.view(), &vec![1.0; colors], &vec![1.0; alphas])
                .is_err()
        );
    }
}

#[test]
fn what_a_caller_does_to_a_frames_arrays_does_not_reach_its_gradients() {
    let scene = Scene::<f32>::random(20, 3, 1);
    let mut frame = frame(&scene, 33);
    let (v_colors, v_alphas) = (vec![1.0; 33 * 33 * 3], vec![1.0; 33 * 33]);
    let before = frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap();
    frame.colors.clear();
    frame.alphas.truncate(3);
    frame.means2d.clear();
    frame.depths.fill(f32::NAN);
    assert!(frame.vjp(&scene.view(), &[], &[1.0; 3]).is_err());
    assert_eq!(frame.vjp(&scene.view(), &v_colors, &v_alphas).unwrap(), before);
}

#[test]
fn settings_that_only_one_scalar_can_tell_apart_are_refused_by_the_other() {
    let settings = RasterSettings {
        max_alpha: 1.0 - 1e-12,
        ..Default::default()
    };
    let error = Renderer::<f32>::new(&settings, RenderMode::Rgb).unwrap_err();
    assert!(error.to_string().starts_with("settings.max_alpha"));
    assert!(Renderer::<f64>::new(&settings, RenderMode::Rgb).is_ok());
}

#[test]
fn a_batch_state_takes_only_gaussians_that_fit_it() {
    let own = Shared::new(20, 3, 17, 2);
    let state = own.batch().unwrap().render().unwrap().1;
    assert!(state.vjp(&own.inputs().gaussians, None, None, ALL).is_ok());
    for other in [
        Shared::new(19, 3, 17, 2),
        Shared::new(21, 3, 17, 2),
        Shared::new(20, 4, 17, 2),
        Shared::new(0, 3, 9, 1),
    ] {
        assert!(state.vjp(&other.inputs().gaussians, None, None, ALL).is_err());
    }
    let mut poisoned = Shared::new(20, 3, 17, 2);
    poisoned.scene.scales[3][1] = f32::NAN;
    let error = state
        .vjp(&poisoned.inputs().gaussians, None, None, ALL)
        .unwrap_err();
    assert_eq!(
        error,
        RasterError::NotFinite {
            name: "scales",
            index: 10
        }
    );
    for (colors, alphas) in [(17 * 17 * 3, 17 * 17), (0, 0)] {
        assert!(
            state
                .vjp(
                    &own.inputs().gaussians,
                    Some(&vec![0.0; colors]),
                    Some(&vec![0.0; alphas]),
                    ALL
                )
                .is_err()
        );
    }
}

#[test]
fn a_batch_without_views_has_gradients_of_zeros() {
    let mut own = Shared::new(4, 3, 9, 1);
    own.shape.entries = 0;
    let (images, state) = own.batch().unwrap().render().unwrap();
    assert!(images.colors.is_empty() && state.median_ids().is_empty());
    let v = state
        .vjp(&own.inputs().gaussians, Some(&[]), Some(&[]), ALL)
        .unwrap();
    assert_eq!((v.means, v.opacities), (vec![0.0; 12], vec![0.0; 4]));
    assert_eq!(v.viewmats, [0.0; 12]);
    assert!(v.means2d.is_empty());
}

#[test]
fn batches_beyond_numbers_are_refused() {
    let mut own = Shared::new(2, 3, 9, 1);
    let huge = [1 << 32, 1 << 33, 1 << 62, 1 << 63, usize::MAX];
    for (entries, cameras) in huge.into_iter().flat_map(|a| huge.map(|b| (a, b))) {
        own.shape.entries = entries;
        own.shape.cameras = cameras;
        assert!(own.batch().is_err(), "{entries} x {cameras}");
        assert!(own.shape.views() >= 1 << 32);
    }
    for size in huge {
        let mut own = Shared::new(2, 3, 9, 1);
        own.shape.width = size;
        assert!(own.batch().is_err());
        own = Shared::new(0, 3, 9, 1);
        own.shape.channels = size;
        assert!(own.batch().is_err() && own.shape.image_channels(RenderMode::RgbDepth) >= 1 << 32);
        own = Shared::new(0, 3, 9, 1);
        own.shape.gaussians = size;
        assert!(own.batch().is_err());
    }
}

#[test]
fn thousands_of_hostile_calls_end_in_errors_or_finite_numbers() {
    type Call = fn(&mut Dice) -> Result<bool, String>;
    let calls: [(&str, Call); 4] = [
        ("f32", one_view::<f32>),
        ("f64", one_view::<f64>),
        ("batch", many_views),
        ("harmonics", harmonics),
    ];
    for (name, call) in calls {
        let mut images = 0;
        for seed in 0..1500 {
            let outcome = catch_unwind(AssertUnwindSafe(|| call(&mut Dice::new(seed))));
            match outcome {
                Ok(Ok(image)) => images += usize::from(image),
                Ok(Err(what)) => panic!("{name}, seed {seed}: {what}"),
                Err(_) => panic!("{name}, seed {seed}: a panic"),
            }
        }
        assert!(images > 30, "{name}: hardly any call passed the checks: {images}");
    }
}

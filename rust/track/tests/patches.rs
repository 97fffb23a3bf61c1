//! Patches on pictures that are a formula, so that every slope and every shift is known.

use bigs_track::{Cut, Laid, Laying, Picture, cut, lay};

const SIDE: usize = 64;

const LAYING: Laying = Laying {
    half: 4,
    iterations: 20,
    least_shown: 0.7,
    likeness: 0.8,
    most_moved: 4.0,
    most_unsure: 0.5,
};

/// A smooth texture at a place.
fn texture(x: f32, y: f32) -> f32 {
    100.0 + 30.0 * (0.45 * x + 0.2 * y).sin() + 25.0 * (0.35 * y - 0.25 * x).cos()
}

/// The picture of `value`, pixel by pixel.
fn drawn(value: impl Fn(f32, f32) -> f32) -> Vec<f32> {
    (0..SIDE * SIDE)
        .map(|pixel| value((pixel % SIDE) as f32 + 0.5, (pixel / SIDE) as f32 + 0.5))
        .collect()
}

fn places(count: usize, seed: u64) -> Vec<[f32; 2]> {
    let mut rng = fastrand::Rng::with_seed(seed);
    (0..count)
        .map(|_| [15.0 + 34.0 * rng.f32(), 15.0 + 34.0 * rng.f32()])
        .collect()
}

fn upright(count: usize) -> Vec<[[f32; 2]; 2]> {
    vec![[[1.0, 0.0], [0.0, 1.0]]; count]
}

fn laid(grey: &[f32], templates: &Cut, starts: &[[f32; 2]], warps: &[[[f32; 2]; 2]]) -> Laid {
    let shown = vec![1.0; SIDE * SIDE];
    let picture = Picture::new(grey, &shown, SIDE, SIDE).unwrap();
    lay(&picture, &templates.templates(), starts, warps, &LAYING).unwrap()
}

fn taken(grey: &[f32], shown: &[f32], places: &[[f32; 2]]) -> Cut {
    cut(
        &Picture::new(grey, shown, SIDE, SIDE).unwrap(),
        places,
        LAYING.half,
    )
    .unwrap()
}

#[test]
fn slopes_of_a_plane_are_its_own() {
    let grey = drawn(|x, y| 3.0 * x - 2.0 * y);
    let found = taken(&grey, &vec![1.0; SIDE * SIDE], &places(20, 0));
    for slope in &found.slope {
        assert!((slope[0] - 3.0).abs() < 1e-3 && (slope[1] + 2.0).abs() < 1e-3);
    }
}

#[test]
fn a_patch_beside_what_is_tracked_weighs_nothing() {
    let shown = drawn(|x, _| f32::from(u8::from(x < 32.0)));
    let grey = drawn(texture);
    let found = taken(&grey, &shown, &[[16.0, 30.0], [32.5, 30.0], [48.0, 30.0]]);
    let share = |patch: usize| {
        found.weight[patch * 81..][..81]
            .iter()
            .filter(|w| **w > 0.0)
            .count()
    };
    assert_eq!((share(0), share(2)), (81, 0));
    assert!(share(1) > 20 && share(1) < 60);
}

#[test]
fn a_shift_is_found_though_the_light_has_changed() {
    let (dx, dy) = (1.3, -0.8);
    let begun = places(200, 1);
    let before = drawn(texture);
    let after = drawn(|x, y| 40.0 + 0.6 * texture(x - dx, y - dy));
    let templates = taken(&before, &vec![1.0; SIDE * SIDE], &begun);
    let found = laid(&after, &templates, &begun, &upright(200));
    assert!(found.fits.iter().filter(|fits| **fits).count() > 190);
    for ((place, start), _) in found
        .places
        .iter()
        .zip(&begun)
        .zip(&found.fits)
        .filter(|(_, fits)| **fits)
    {
        assert!((place[0] - start[0] - dx).hypot(place[1] - start[1] - dy) < 0.03);
    }
}

#[test]
fn the_error_told_is_the_error_made_in_each_direction() {
    // Steep across, gentle along: noise moves a patch further along.
    let across = |x: f32, y: f32| 100.0 + 40.0 * (0.6 * x).sin() + 12.0 * (0.5 * y + 0.1 * x).cos();
    let begun = places(400, 8);
    let templates = taken(&drawn(across), &vec![1.0; SIDE * SIDE], &begun);
    let mut off = [0.0f32; 2];
    let mut told = [0.0f32; 2];
    for seed in 0..20 {
        let mut rng = fastrand::Rng::with_seed(seed);
        let mut noisy = drawn(across);
        for grey in &mut noisy {
            *grey += 8.0 * (rng.f32() + rng.f32() + rng.f32() - 1.5);
        }
        let found = laid(&noisy, &templates, &begun, &upright(400));
        for patch in (0..400).filter(|&patch| found.fits[patch]) {
            for axis in 0..2 {
                off[axis] += (found.places[patch][axis] - begun[patch][axis]).powi(2);
                told[axis] += found.covariances[patch][2 * axis];
            }
        }
    }
    assert!(off[1] > 3.0 * off[0]);
    for axis in 0..2 {
        let ratio = (off[axis] / told[axis]).sqrt();
        assert!((0.8..1.6).contains(&ratio), "axis {axis}: {ratio}");
    }
}

#[test]
fn a_covariance_turns_with_the_warp() {
    let begun = places(50, 9);
    let templates = taken(&drawn(texture), &vec![1.0; SIDE * SIDE], &begun);
    // The same picture on its side: right is down, and down is left.
    let side = drawn(|x, y| texture(y, SIDE as f32 - x));
    let turned: Vec<[f32; 2]> = begun.iter().map(|[x, y]| [SIDE as f32 - y, *x]).collect();
    let upright = laid(
        &drawn(|x, y| texture(x, y) + 5.0 * (1.7 * x).sin()),
        &templates,
        &begun,
        &upright(50),
    );
    let side = {
        let ripple = drawn(|_, y| 5.0 * (1.7 * y).sin());
        let grey: Vec<f32> = side.iter().zip(&ripple).map(|(a, b)| a + b).collect();
        laid(&grey, &templates, &turned, &vec![[[0.0, -1.0], [1.0, 0.0]]; 50])
    };
    for (a, b) in upright.covariances.iter().zip(&side.covariances) {
        let size = a[0] + a[2];
        assert!((a[0] - b[2]).abs() < 0.05 * size);
        assert!((a[2] - b[0]).abs() < 0.05 * size);
        assert!((a[1] + b[1]).abs() < 0.05 * size);
    }
}

#[test]
fn a_turned_patch_is_laid_by_its_warp() {
    let turn = 0.4f32;
    let (cos, sin) = (turn.cos(), turn.sin());
    let middle = [32.0, 32.0];
    // What the turned picture shows at a place, the first showed at the place turned back.
    let back = |x: f32, y: f32| {
        let (x, y) = (x - middle[0], y - middle[1]);
        (middle[0] + cos * x + sin * y, middle[1] - sin * x + cos * y)
    };
    let after = drawn(|x, y| {
        let (x, y) = back(x, y);
        texture(x, y)
    });
    let begun: Vec<[f32; 2]> = places(100, 2);
    let templates = taken(&drawn(texture), &vec![1.0; SIDE * SIDE], &begun);
    let landed = |[x, y]: [f32; 2]| {
        let (x, y) = (x - middle[0], y - middle[1]);
        [middle[0] + cos * x - sin * y, middle[1] + sin * x + cos * y]
    };
    let starts: Vec<[f32; 2]> = begun.iter().map(|&p| landed(p).map(|v| v + 0.7)).collect();
    let found = laid(&after, &templates, &starts, &vec![[[cos, -sin], [sin, cos]]; 100]);
    assert!(found.fits.iter().filter(|fits| **fits).count() > 80);
    for ((place, begun), _) in found
        .places
        .iter()
        .zip(&begun)
        .zip(&found.fits)
        .filter(|(_, fits)| **fits)
    {
        let wanted = landed(*begun);
        assert!((place[0] - wanted[0]).hypot(place[1] - wanted[1]) < 0.05);
    }
}

#[test]
fn upright_patches_and_barely_turned_ones_land_alike() {
    let begun = places(100, 3);
    let templates = taken(&drawn(texture), &vec![1.0; SIDE * SIDE], &begun);
    let after = drawn(|x, y| texture(x - 0.6, y + 0.4));
    let upright = laid(&after, &templates, &begun, &upright(100));
    let turned = laid(&after, &templates, &begun, &vec![[[1.0, 1e-7], [0.0, 1.0]]; 100]);
    assert_eq!(upright.fits, turned.fits);
    for (a, b) in upright.places.iter().zip(&turned.places) {
        assert!((a[0] - b[0]).abs().max((a[1] - b[1]).abs()) < 1e-3);
    }
}

#[test]
fn noise_and_even_pictures_are_not_recognised() {
    let mut rng = fastrand::Rng::with_seed(4);
    let begun = places(100, 4);
    let templates = taken(&drawn(texture), &vec![1.0; SIDE * SIDE], &begun);
    let noise: Vec<f32> = (0..SIDE * SIDE).map(|_| 255.0 * rng.f32()).collect();
    for picture in [noise, vec![90.0; SIDE * SIDE]] {
        let found = laid(&picture, &templates, &begun, &upright(100));
        assert!(found.fits.iter().filter(|fits| **fits).count() <= 2);
    }
}

#[test]
fn nothing_breaks_on_places_that_are_none_and_values_that_are_no_numbers() {
    let mut grey = drawn(texture);
    grey[1000] = f32::NAN;
    grey[2000] = f32::INFINITY;
    let odd = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        -1e30,
        1e30,
        0.0,
        -3.0,
        64.0,
        70.0,
    ];
    let starts: Vec<[f32; 2]> = odd
        .iter()
        .flat_map(|&x| odd.iter().map(move |&y| [x, y]))
        .collect();
    let templates = taken(&grey, &vec![1.0; SIDE * SIDE], &starts);
    for warp in [
        [[1.0, 0.0], [0.0, 1.0]],
        [[f32::NAN, 0.0], [0.0, 1.0]],
        [[1e30, 0.0], [0.0, -1e30]],
    ] {
        let found = laid(&grey, &templates, &starts, &vec![warp; starts.len()]);
        for (start, fits) in starts.iter().zip(&found.fits) {
            assert!(!fits || start.iter().all(|value| value.is_finite()));
        }
    }
}

#[test]
fn the_smallest_pictures_hold_patches() {
    for (width, height) in [(1, 1), (1, 5), (5, 1), (2, 2), (9, 10)] {
        let grey = vec![10.0; width * height];
        let picture = Picture::new(&grey, &grey, width, height).unwrap();
        let templates = cut(&picture, &[[0.5, 0.5]], 4).unwrap();
        let found = lay(
            &picture,
            &templates.templates(),
            &[[0.5, 0.5]],
            &upright(1),
            &LAYING,
        )
        .unwrap();
        assert!(!found.fits[0]);
    }
}

#[test]
fn arrays_that_do_not_fit_together_are_refused() {
    let grey = drawn(texture);
    let picture = Picture::new(&grey, &grey, SIDE, SIDE).unwrap();
    let templates = cut(&picture, &places(3, 5), 4).unwrap();
    let refused = [
        Picture::new(&grey, &grey[1..], SIDE, SIDE).err(),
        Picture::new(&[], &[], 0, SIDE).err(),
        cut(&picture, &places(3, 5), 0).err(),
        lay(
            &picture,
            &templates.templates(),
            &places(2, 5),
            &upright(2),
            &LAYING,
        )
        .err(),
        lay(
            &picture,
            &templates.templates(),
            &places(3, 5),
            &upright(2),
            &LAYING,
        )
        .err(),
    ];
    let told: Vec<String> = refused
        .into_iter()
        .map(|error| error.unwrap().to_string())
        .collect();
    assert_eq!(
        told,
        [
            "shown: expected 4096 values, found 4095",
            "pixels: expected at least 1, found 0",
            "half: expected at least 1, found 0",
            "grey: expected 162 values, found 243",
            "warps: expected 3 values, found 2",
        ]
    );
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let begun = places(300, 6);
    let templates = taken(&drawn(texture), &vec![1.0; SIDE * SIDE], &begun);
    let after = drawn(|x, y| texture(x - 0.6, y + 0.4));
    let within = |threads: usize| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap()
            .install(|| laid(&after, &templates, &begun, &upright(300)))
    };
    assert_eq!(within(1), within(3));
}

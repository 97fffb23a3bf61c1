//! Shapes whose answers are formulas: a ball before a camera, a box's mirror planes.

use bigs_shape::{
    Cones, Empty, Facing, Judge, Kind, Samples, Symmetry, Vec3, Views, beyond_planes, border_distances,
};

const SIDE: usize = 120;
const RADIUS: f64 = 0.05;
const DISTANCE: f64 = 0.5;
const STILL: [f64; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];

fn views<'a>(rotations: &'a [[f64; 9]], centers: &'a [Vec3]) -> Views<'a> {
    Views {
        width: SIDE,
        height: SIDE,
        focal: [400.0; 2],
        middle: [60.0; 2],
        rotations,
        centers,
    }
}

fn unit(v: Vec3) -> Vec3 {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    v.map(|x| x / length)
}

fn random(rng: &mut fastrand::Rng) -> Vec3 {
    std::array::from_fn(|_| 2.0 * rng.f64() - 1.0)
}

/// Whether a ray through a pixel hits the ball, and the pixel's distance to its outline.
fn outline() -> (Vec<bool>, Vec<f32>) {
    let radius = 400.0 * (RADIUS / DISTANCE).asin().tan();
    let distances = (0..SIDE * SIDE).map(|pixel| {
        let (x, y) = ((pixel % SIDE) as f64 - 59.5, (pixel / SIDE) as f64 - 59.5);
        (x.hypot(y) - radius) as f32
    });
    let distances: Vec<f32> = distances.collect();
    (distances.iter().map(|&d| d < 0.0).collect(), distances)
}

#[test]
fn cones_touch_the_ball() {
    let (_, silhouette) = outline();
    let order = [0];
    let cones = Cones {
        silhouettes: &silhouette,
        order: &order,
        agreeing: 1,
        stop: f64::INFINITY,
    };
    let (rotations, centers) = ([STILL], [[0.0, 0.0, DISTANCE]]);
    let points = [[0.0; 3], [RADIUS, 0.0, 0.0], [0.0, 0.07, 0.0], [0.0, 0.0, -1.0]];
    let found = views(&rotations, &centers).cones(&cones, &points).unwrap();
    assert!((found[0] + RADIUS).abs() < 1e-3);
    assert!(found[1].abs() < 1e-3);
    assert!((found[2] - 0.02).abs() < 1e-3);
    // Behind the camera it is not seen, and counts as inside.
    assert_eq!(found[3], -1.0);
}

#[test]
fn the_near_side_shows_and_hides() {
    let (shown, _) = outline();
    let mut rng = fastrand::Rng::with_seed(0);
    let normals: Vec<Vec3> = (0..20_000).map(|_| unit(random(&mut rng))).collect();
    let surface: Vec<Vec3> = normals.iter().map(|n| n.map(|x| RADIUS * x)).collect();
    let (rotations, centers) = ([STILL], [[0.0, 0.0, DISTANCE]]);
    let views = views(&rotations, &centers);
    let facing = Facing {
        normals: &normals,
        least_cosine: 0.2,
    };
    let seen = views
        .times_seen(&shown, &surface, &facing, &surface, 0.006)
        .unwrap();
    for (normal, &seen) in normals.iter().zip(&seen) {
        if normal[2] < -0.5 {
            assert_eq!(seen, 1);
        }
        if normal[2] > 0.0 {
            assert_eq!(seen, 0);
        }
    }
    let points = [[0.0, 0.0, -0.08], [0.0, 0.0, -0.052], [0.0; 3], [0.2, 0.0, 0.0]];
    assert_eq!(
        views.times_empty(&shown, &points, &surface, 0.006).unwrap(),
        [1, 0, 0, 0]
    );
}

#[test]
fn planes_of_a_cube() {
    let planes: Vec<[f64; 4]> = (0..6)
        .map(|i| {
            std::array::from_fn(|j| {
                if j == 3 {
                    -1.0
                } else if j == i / 2 {
                    1.0 - 2.0 * (i % 2) as f64
                } else {
                    0.0
                }
            })
        })
        .collect();
    let found = beyond_planes(&[[0.0; 3], [0.5, -0.9, 0.0], [3.0, 0.0, -2.0]], &planes);
    for (found, wanted) in found.iter().zip([-1.0, -0.1, 2.0]) {
        assert!((found - wanted).abs() < 1e-12);
    }
}

/// Samples of three faces of a box that meet in a corner, with a colour by height.
fn corner() -> Samples {
    let mut rng = fastrand::Rng::with_seed(1);
    let half = [0.06, 0.03, 0.045];
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    for index in 0..4500 {
        let face = index % 3;
        let inside = random(&mut rng);
        points.push(std::array::from_fn(|i| {
            if i == face { half[i] } else { half[i] * inside[i] }
        }));
        normals.push(std::array::from_fn(|i| f64::from(u8::from(i == face))));
    }
    let colors = points.iter().map(|p: &Vec3| [p[2], 0.5, 0.5]).collect();
    Samples {
        points,
        normals,
        colors,
    }
}

/// Empty beyond a box about the origin.
fn beyond() -> Empty {
    let size = 40;
    let place = |i: usize| -0.1 + 0.2 * i as f64 / (size - 1) as f64;
    let mut values = Vec::new();
    for x in 0..size {
        for y in 0..size {
            for z in 0..size {
                let out = place(x).abs() > 0.065 || place(y).abs() > 0.035 || place(z).abs() > 0.05;
                values.push(f64::from(u8::from(out)));
            }
        }
    }
    Empty {
        values,
        size: [size; 3],
        origin: [-0.1; 3],
        spacing: 0.2 / (size - 1) as f64,
    }
}

fn judge() -> Judge {
    Judge::new(corner(), beyond(), (0.003, 0.82), (12, 8)).unwrap()
}

fn plane(point: Vec3, direction: Vec3) -> Symmetry {
    Symmetry {
        kind: Kind::Plane,
        point,
        direction: unit(direction),
    }
}

#[test]
fn true_planes_agree() {
    let candidates = [
        plane([0.0; 3], [1.0, 0.0, 0.0]),
        plane([0.02, 0.0, 0.0], [1.0, 0.0, 0.0]),
        plane([0.0; 3], [1.0, 1.0, 0.0]),
    ];
    let found = judge().agreement(&candidates);
    assert!(found[0].support > 0.5 && found[0].contradiction == 0.0 && found[0].color_error < 0.003);
    for other in &found[1..] {
        assert!(other.contradiction > 0.15);
    }
}

/// Samples of an ellipsoid's upper half.
fn dome() -> Samples {
    let mut rng = fastrand::Rng::with_seed(3);
    let axes = [0.06, 0.03, 0.045];
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    for _ in 0..4000 {
        let mut place = unit(random(&mut rng));
        place[2] = place[2].abs();
        points.push(std::array::from_fn(|i| axes[i] * place[i]));
        normals.push(unit(std::array::from_fn(|i| place[i] / axes[i])));
    }
    Samples {
        colors: points.clone(),
        points,
        normals,
    }
}

#[test]
fn a_plane_finds_its_place() {
    let judge = Judge::new(dome(), beyond(), (0.003, 0.82), (12, 8)).unwrap();
    let start = plane([0.002, 0.0, 0.0], [1.0, 0.05, -0.04]);
    let found = judge.refined(&[start], 0.12)[0];
    assert!(found.direction[0].abs() > 0.9999);
    let along: f64 = (0..3).map(|i| found.point[i] * found.direction[i]).sum();
    assert!(along.abs() < 3e-4);
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let mut rng = fastrand::Rng::with_seed(2);
    let candidates: Vec<Symmetry> = (0..6)
        .map(|index| Symmetry {
            kind: if index % 2 == 0 { Kind::Plane } else { Kind::Axis },
            ..plane(random(&mut rng).map(|x| 0.01 * x), random(&mut rng))
        })
        .collect();
    let judge = judge();
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap()
            .install(|| (judge.agreement(&candidates), judge.refined(&candidates, 0.12)))
    };
    // Where no colours meet, their difference is no number, which equals nothing.
    assert_eq!(format!("{:?}", with(1)), format!("{:?}", with(4)));
}

#[test]
fn what_does_not_fit_or_is_no_number() {
    let (rotations, centers) = ([STILL], [[0.0, 0.0, f64::NAN]]);
    let views = views(&rotations, &centers);
    let shown = vec![true; SIDE * SIDE];
    assert!(views.times_empty(&shown[1..], &[], &[], 0.0).is_err());
    assert_eq!(
        views.times_empty(&shown, &[[0.0; 3]], &[[0.0; 3]], 0.0).unwrap(),
        [0]
    );
    let mut samples = corner();
    samples.colors.pop();
    assert!(Judge::new(samples, beyond(), (0.003, 0.82), (12, 8)).is_err());
    let mut samples = corner();
    samples.points[3] = [f64::NAN; 3];
    let judge = Judge::new(samples, beyond(), (0.003, 0.82), (12, 8)).unwrap();
    assert!(judge.agreement(&[plane([0.0; 3], [1.0, 0.0, 0.0])])[0].support > 0.5);
    assert_eq!(
        judge.agreement(&[plane([f64::NAN; 3], [1.0, 0.0, 0.0])])[0].support,
        0.0
    );
}

#[test]
fn a_masks_border_is_as_far_as_the_nearest_pixel_across() {
    let mut rng = fastrand::Rng::with_seed(3);
    let (width, height) = (31, 23);
    let inside: Vec<bool> = (0..width * height).map(|_| rng.f64() < 0.9).collect();
    let expected = (0..width * height).map(|here| {
        let across = (0..width * height).filter(|&there| inside[there] != inside[here]);
        let square = across.map(|there| {
            let (x, y) = (
                (here % width).abs_diff(there % width),
                (here / width).abs_diff(there / width),
            );
            x * x + y * y
        });
        let distance = (square.min().unwrap() as f64).sqrt() - 0.5;
        (if inside[here] { -distance } else { distance }) as f32
    });
    let expected: Vec<f32> = expected.collect();
    for threads in [1, 2, 5] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let found = pool.unwrap().install(|| border_distances(&inside, width, height));
        assert_eq!(found.unwrap(), expected);
    }
    assert!(border_distances(&inside, width, height + 1).is_err());
}

//! What a mesh covers: areas and gradients known by hand, what does not count, threads, and refusals.

use bigs_ops::OpsError;
use bigs_ops::outline::Mesh;

const WIDTH: usize = 40;
const HEIGHT: usize = 30;
const INTRINSICS: [[f64; 3]; 2] = [[50.0, 0.0, 20.0], [0.0, 50.0, 15.0]];

/// Points that are seen at these places of the picture, two metres away.
fn at(places: &[[f64; 2]]) -> Vec<[f64; 3]> {
    places
        .iter()
        .map(|[x, y]| [2.0 * (x - 20.0) / 50.0, 2.0 * (y - 15.0) / 50.0, 2.0])
        .collect()
}

fn mesh<'a>(points: &'a [[f64; 3]], faces: &'a [[usize; 3]]) -> Mesh<'a, f64> {
    Mesh {
        frames: 1,
        points,
        faces,
        intrinsics: INTRINSICS,
        size: [WIDTH, HEIGHT],
    }
}

/// The covered pixels, and the gradient of their sum in pixels.
fn area(points: &[[f64; 3]], faces: &[[usize; 3]]) -> (f64, Vec<[f64; 2]>) {
    let mesh = mesh(points, faces);
    let covered = mesh.cover().unwrap();
    let gradient = mesh.vjp(&covered, &[1.0; WIDTH * HEIGHT]).unwrap();
    let sum = covered.shares::<f64>().unwrap().iter().sum();
    // A metre is 25 pixels at that distance.
    (sum, gradient.iter().map(|v| [v[0] / 25.0, v[1] / 25.0]).collect())
}

#[test]
fn a_triangles_area_changes_as_its_corners_move() {
    // A corner adds half the length of the opposite side, along that side's normal.
    let (sum, gradient) = area(&at(&[[5.0, 5.0], [35.0, 5.0], [5.0, 25.0]]), &[[0, 1, 2]]);
    assert!((sum - 300.0).abs() < 3.0, "{sum}");
    for (found, true_one) in gradient.iter().zip([[-10.0, -15.0], [10.0, 0.0], [0.0, 15.0]]) {
        for (found, true_one) in found.iter().zip(true_one) {
            assert!((found - true_one).abs() < 1e-9, "{gradient:?}");
        }
    }
}

#[test]
fn winding_and_the_cut_into_triangles_do_not_matter() {
    let square = at(&[[10.2, 7.3], [30.6, 8.1], [29.7, 22.4], [9.1, 21.2]]);
    let (sum, gradient) = area(&square, &[[0, 1, 2], [0, 2, 3]]);
    for faces in [
        [[0, 2, 1], [0, 2, 3]],
        [[0, 1, 3], [1, 2, 3]],
        [[3, 1, 0], [3, 1, 2]],
    ] {
        let (other, pulls) = area(&square, &faces);
        assert_eq!(sum, other);
        for (one, other) in gradient.as_flattened().iter().zip(pulls.as_flattened()) {
            assert!((one - other).abs() < 1e-9);
        }
    }
}

#[test]
fn a_heap_of_triangles_covers_what_each_of_them_covers() {
    let mut random = fastrand::Rng::with_seed(7);
    // Few vertices: edges have many triangles, some of which use a vertex twice. Some places are outside the picture.
    let places: Vec<[f64; 2]> = (0..9)
        .map(|_| [60.0 * random.f64() - 10.0, 50.0 * random.f64() - 10.0])
        .collect();
    for count in [1, 2, 5, 20] {
        let faces: Vec<[usize; 3]> = (0..count)
            .map(|_| [0, 1, 2].map(|_| random.usize(0..9)))
            .collect();
        let inside = |x: f64, y: f64| {
            faces.iter().any(|face| {
                let [a, b, c] = face.map(|vertex| places[vertex]);
                let turn = |p: [f64; 2], q: [f64; 2]| (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]);
                let turns = [turn(a, b), turn(b, c), turn(c, a)];
                turns.iter().all(|&t| t > 0.0) || turns.iter().all(|&t| t < 0.0)
            })
        };
        let points = at(&places);
        let shares = mesh(&points, &faces).cover().unwrap().shares::<f64>().unwrap();
        for (pixel, share) in shares.into_iter().enumerate() {
            let samples = (0..32).filter(|sample| {
                let x = (pixel % WIDTH) as f64 + (f64::from(sample % 8) + 0.5) / 8.0;
                let y = (pixel / WIDTH) as f64 + (f64::from(sample / 8) + 0.5) / 4.0;
                inside(x, y)
            });
            assert_eq!(
                share,
                samples.count() as f64 / 32.0,
                "{count} triangles, pixel {pixel}"
            );
        }
    }
}

#[test]
fn edges_that_lie_on_each_other_count_once() {
    let triangle = [[5.0, 5.0], [35.0, 6.0], [12.0, 25.0]];
    let twice = at(&[triangle, triangle].concat());
    let (sum, gradient) = area(&at(&triangle), &[[0, 1, 2]]);
    let (both, pulls) = area(&twice, &[[0, 1, 2], [3, 4, 5]]);
    assert_eq!(sum, both);
    for vertex in 0..3 {
        for axis in 0..2 {
            let together = pulls[vertex][axis] + pulls[vertex + 3][axis];
            assert!((together - gradient[vertex][axis]).abs() < 1e-9);
        }
    }
}

#[test]
fn what_something_covers_or_no_picture_shows_moves_nothing() {
    let places = [
        [2.0, 2.0],
        [38.0, 2.0],
        [20.0, 28.0],
        [18.0, 8.0],
        [22.0, 8.0],
        [20.0, 12.0],
    ];
    let (_, gradient) = area(&at(&places), &[[0, 1, 2], [3, 4, 5]]);
    assert!(gradient[3..].as_flattened().iter().all(|&v| v == 0.0));
    let mut behind = at(&places[..3]);
    behind[1][2] = -1.0;
    assert_eq!(area(&behind, &[[0, 1, 2]]), (0.0, vec![[0.0; 2]; 3]));
    let (sum, gradient) = area(
        &at(&[[-50.0, -90.0], [-10.0, -90.0], [-30.0, -40.0]]),
        &[[0, 1, 2]],
    );
    assert_eq!((sum, gradient), (0.0, vec![[0.0; 2]; 3]));
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let mut random = fastrand::Rng::with_seed(3);
    let points: Vec<[f64; 3]> = (0..5 * 30)
        .map(|_| [random.f64() - 0.5, random.f64() - 0.5, 1.0 + random.f64()])
        .collect();
    let faces: Vec<[usize; 3]> = (0..40).map(|_| [0, 1, 2].map(|_| random.usize(0..30))).collect();
    let v: Vec<f64> = (0..5 * WIDTH * HEIGHT).map(|_| random.f64()).collect();
    let mesh = Mesh {
        frames: 5,
        ..mesh(&points, &faces)
    };
    let work = || {
        let covered = mesh.cover().unwrap();
        (covered.shares::<f64>().unwrap(), mesh.vjp(&covered, &v).unwrap())
    };
    let of = |threads: usize| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap()
            .install(work)
    };
    assert_eq!(of(1), of(3));
}

#[test]
fn refusals() {
    let points = at(&[[5.0, 5.0], [35.0, 6.0], [12.0, 25.0]]);
    let covered = mesh(&points, &[[0, 1, 2]]).cover().unwrap();
    assert!(matches!(
        mesh(&points, &[[0, 1, 3]]).cover(),
        Err(OpsError::BadSize {
            name: "faces",
            got: 3,
            ..
        })
    ));
    assert!(matches!(
        mesh(&points, &[[0, 1, 2]]).vjp(&covered, &[0.0; 3]),
        Err(OpsError::LengthMismatch { name: "v_shares", .. })
    ));
    let two = Mesh {
        frames: 2,
        ..mesh(&points, &[])
    };
    assert!(matches!(
        two.cover(),
        Err(OpsError::LengthMismatch { name: "points", .. })
    ));
    let three = Mesh {
        frames: 3,
        ..mesh(&points, &[])
    };
    assert!(matches!(
        three.vjp(&covered, &[0.0; 3 * WIDTH * HEIGHT]),
        Err(OpsError::LengthMismatch { name: "covered", .. })
    ));
    let turned = Mesh {
        size: [HEIGHT, WIDTH],
        ..mesh(&points, &[])
    };
    assert!(matches!(
        turned.vjp(&covered, &[0.0; WIDTH * HEIGHT]),
        Err(OpsError::BadSize { name: "covered", .. })
    ));
    let mut lost = points.clone();
    lost[1][2] = f64::NAN;
    assert!(matches!(
        mesh(&lost, &[[0, 1, 2]]).cover(),
        Err(OpsError::NotFinite {
            name: "points",
            index: 5
        })
    ));
}

//! What of a hand touches an object: gradients against finite differences, a case known by hand, and refusals.

use bigs_ops::distance::Grid;
use bigs_ops::groups::Group;
use bigs_ops::joints::rotations;
use bigs_ops::pose::Subject;
use bigs_ops::touch::{Object, Touch, TouchGradients};

const H: f64 = 1e-6;
const FRAMES: usize = 2;
const VERTS: usize = 12;
const BONES: usize = 3;

fn random(seed: u64, count: usize) -> Vec<f64> {
    let mut random = fastrand::Rng::with_seed(seed);
    (0..count).map(|_| random.f64()).collect()
}

fn threes(flat: &[f64]) -> &[[f64; 3]] {
    flat.as_chunks().0
}

fn grid(values: &[f64]) -> Grid<'_, f64> {
    Grid {
        values,
        size: [6, 5, 4],
        bounds: [[-1.0, -1.2, -0.8], [1.1, 1.0, 0.9]],
    }
}

fn whole(deepest: usize) -> Group {
    Group {
        deepest,
        vertices: None,
    }
}

fn some(deepest: usize, vertices: &[usize]) -> Group {
    Group {
        deepest,
        vertices: Some(vertices.to_vec()),
    }
}

/// Points, bones, rotations, centres and scale, one after the other.
struct Inputs([Vec<f64>; 5]);

impl Inputs {
    fn random(moving: bool) -> Self {
        let turns = rotations(threes(&random(2, 3 * FRAMES))).as_flattened().to_vec();
        let points: Vec<f64> = random(1, 3 * VERTS * if moving { FRAMES } else { 1 })
            .iter()
            .map(|v| 4.0 * v - 2.0)
            .collect();
        let bones = random(3, FRAMES * BONES * 12);
        Self([points, bones, turns, random(4, 3 * FRAMES), vec![1.3]])
    }

    /// A loss of what touches, and its gradients.
    fn loss(&self, mirrored: bool) -> (f64, TouchGradients<f64>) {
        let (values, weights) = (
            random(5, 120).iter().map(|v| v - 0.6).collect::<Vec<_>>(),
            random(6, VERTS * BONES),
        );
        let [points, bones, turns, centers, scale] = &self.0;
        let hand = Subject {
            count: VERTS,
            points: threes(points),
            weights: &weights,
            bones,
            bone_size: 12,
            mirrored,
            surface: None,
        };
        let object = Object {
            grid: grid(&values),
            rotations: turns.as_chunks().0,
            centers: threes(centers),
            scale: scale[0],
        };
        // Vertices 3 to 8 may count to both.
        let touch = Touch::new(hand, object, &[whole(4), some(2, &[3, 4, 6, 8])], 0.05).unwrap();
        let touched = touch.measure().unwrap();
        let (v_depths, v_sunk) = ([0.7, -0.3, -1.1, 0.8], [0.4, 0.9]);
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        (
            dot(&touched.depths, &v_depths) + dot(&touched.sunk, &v_sunk),
            touch.vjp(&touched, Some(&v_depths), Some(&v_sunk)).unwrap(),
        )
    }
}

#[test]
fn gradients_are_finite_differences() {
    for (moving, mirrored) in [(false, false), (true, true)] {
        let mut inputs = Inputs::random(moving);
        let (_, found) = inputs.loss(mirrored);
        let found = [
            found.points.into_flattened(),
            found.bones,
            found.rotations.into_flattened(),
            found.centers.into_flattened(),
            vec![found.scale],
        ];
        for (which, gradients) in found.iter().enumerate() {
            for (i, &gradient) in gradients.iter().enumerate() {
                let mut at = |by: f64| {
                    let before = inputs.0[which][i];
                    inputs.0[which][i] = before + by;
                    let loss = inputs.loss(mirrored).0;
                    inputs.0[which][i] = before;
                    loss
                };
                let expected = (at(H) - at(-H)) / (2.0 * H);
                assert!(
                    (gradient - expected).abs() < 1e-6 * (1.0 + expected.abs()),
                    "input {which}, {i}: {gradient} and {expected}"
                );
            }
        }
    }
}

/// A hand of some points, which one bone leaves where they are, before a plane at x = 0: inside is below.
fn before_a_plane<R>(
    points: &[[f64; 3]],
    groups: &[Group],
    test: impl FnOnce(Result<Touch<'_, f64>, String>) -> R,
) -> R {
    let values: Vec<f64> = (0..8).map(|i| if i % 2 == 0 { -1.0 } else { 1.0 }).collect();
    let bone = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let weights = vec![1.0; points.len()];
    let hand = Subject {
        count: points.len(),
        points,
        weights: &weights,
        bones: &bone,
        bone_size: 12,
        mirrored: false,
        surface: None,
    };
    let object = Object {
        grid: Grid {
            values: &values,
            size: [2, 2, 2],
            bounds: [[-1.0; 3], [1.0; 3]],
        },
        rotations: &[[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]],
        centers: &[[0.0; 3]],
        scale: 1.0,
    };
    test(Touch::new(hand, object, groups, 0.1).map_err(|error| error.to_string()))
}

#[test]
fn the_deepest_are_averaged_and_what_is_sunk_is_squared() {
    let points = [
        [0.5, 0.0, 0.0],
        [-0.3, 0.0, 0.0],
        [-0.2, 0.3, 0.0],
        [0.1, 0.0, 0.4],
    ];
    before_a_plane(&points, &[whole(3)], |touch| {
        let touch = touch.unwrap();
        let touched = touch.measure().unwrap();
        // The way to the box counts a millionth inside it.
        assert!((touched.depths[0] - (0.1 - 0.3 - 0.2) / 3.0).abs() < 2e-6);
        assert!((touched.sunk[0] - (0.2f64.powi(2) + 0.1f64.powi(2))).abs() < 2e-6);
        let found = touch.vjp(&touched, Some(&[3.0]), None).unwrap();
        let along: Vec<f64> = found.points.iter().map(|v| v[0].round()).collect();
        assert_eq!(along, [0.0, 1.0, 1.0, 1.0]);
        let none = touch.vjp(&touched, None, None).unwrap();
        assert!(none.points.as_flattened().iter().all(|&v| v == 0.0));
    });
}

#[test]
fn every_group_has_its_own_deepest() {
    let points = [
        [0.5, 0.0, 0.0],
        [-0.3, 0.0, 0.0],
        [-0.05, 0.3, 0.0],
        [0.1, 0.0, 0.4],
    ];
    let groups = [some(1, &[0, 3]), whole(1), some(9, &[2, 3])];
    before_a_plane(&points, &groups, |touch| {
        let touch = touch.unwrap();
        let touched = touch.measure().unwrap();
        let expected = [0.1, -0.3, 0.025];
        assert!(
            touched
                .depths
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 2e-6)
        );
        let found = touch.vjp(&touched, Some(&[1.0, 10.0, 4.0]), None).unwrap();
        let along: Vec<f64> = found.points.iter().map(|v| v[0].round()).collect();
        assert_eq!(along, [0.0, 10.0, 2.0, 3.0]);
    });
    // Without groups only what is sunk is left.
    before_a_plane(&points, &[], |touch| {
        let touched = touch.unwrap().measure().unwrap();
        assert!(touched.depths.is_empty() && (touched.sunk[0] - 0.04).abs() < 1e-5);
    });
}

#[test]
fn what_does_not_fit_is_refused() {
    let point = [[0.0; 3]];
    for (points, group) in [
        (&point[..0], whole(3)),
        (&point, whole(0)),
        (&point, some(1, &[])),
        (&point, some(1, &[1])),
        (&[[0.0; 3]; 3], some(1, &[1, 1])),
        (&[[0.0; 3]; 3], some(1, &[2, 0])),
    ] {
        before_a_plane(points, &[group], |touch| {
            assert!(touch.unwrap_err().starts_with("groups"))
        });
    }
    let many = vec![whole(1); 33];
    before_a_plane(&point, &many, |touch| {
        assert!(touch.unwrap_err().starts_with("groups"))
    });
    let thin = Grid {
        size: [120, 1, 1],
        ..grid(&[0.0; 120])
    };
    let refused = thin.distances(&[[0.0; 3]]).unwrap_err().to_string();
    assert!(refused.starts_with("values"));
    let short = grid(&[0.0; 60]).distances(&[]).unwrap_err().to_string();
    assert!(short.starts_with("values"));
}

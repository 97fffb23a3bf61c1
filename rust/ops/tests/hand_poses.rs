//! A hand's poses from what was learned: gradients against finite differences, a grasp known by hand, and refusals.

use bigs_ops::hand_poses::{HandPoses, Held, PosePulls, PosedHand, Residuals, Start};
use bigs_ops::joints::rotations;

const H: f64 = 1e-6;
const CLIP: usize = 3;
const JOINTS: usize = 2;
const FRAMES: [usize; 3] = [2, 0, 2];
const OF_FRAME: [i64; CLIP] = [1, -1, 0];

fn random(seed: u64, count: usize) -> Vec<f64> {
    let mut random = fastrand::Rng::with_seed(seed);
    (0..count).map(|_| random.f64() - 0.5).collect()
}

fn threes(flat: &[f64]) -> &[[f64; 3]] {
    flat.as_chunks().0
}

fn turns(seed: u64, count: usize) -> Vec<[f64; 9]> {
    rotations(threes(&random(seed, 3 * count)))
}

/// What gradients reach: residuals of orient, fingers, bias, ray and depth, and of grasps orient, fingers and position,
/// then the object's rotations, centres and scale.
struct Inputs([Vec<f64>; 11]);

impl Inputs {
    fn random() -> Self {
        let sizes = [9, 18, 6, 6, 3, 6, 12, 6, 27, 9, 1];
        let mut values: [Vec<f64>; 11] = std::array::from_fn(|i| random(20 + i as u64, sizes[i]));
        values[8] = turns(40, FRAMES.len()).as_flattened().to_vec();
        // In front of the camera.
        for center in values[9].chunks_exact_mut(3) {
            center[2] += 2.0;
        }
        values[10][0] = 1.2;
        Self(values)
    }

    fn with<R>(&self, mirrored: bool, test: impl FnOnce(&HandPoses<'_, f64>) -> R) -> R {
        let [
            orient,
            fingers,
            bias,
            ray,
            depth,
            g_orient,
            g_fingers,
            g_position,
            turned,
            centers,
            scale,
        ] = &self.0;
        let (base_orient, base_fingers) = (turns(1, CLIP), turns(2, CLIP * JOINTS));
        let (base_ray, base_depth) = (random(3, 2 * CLIP), random(4, CLIP));
        let (held_orient, held_fingers) = (turns(5, 2), turns(6, 2 * JOINTS));
        let held_position = random(7, 6);
        test(&HandPoses {
            frames: &FRAMES,
            start: Start {
                orient: &base_orient,
                fingers: &base_fingers,
                ray: base_ray.as_chunks().0,
                log_depth: &base_depth,
            },
            residuals: Residuals {
                orient: threes(orient),
                fingers: threes(fingers),
                bias: threes(bias),
                ray: ray.as_chunks().0,
                log_depth: depth,
            },
            held: Some(Held {
                of_frame: &OF_FRAME,
                slack: 0.3,
                mirrored,
                base_orient: &held_orient,
                base_fingers: &held_fingers,
                base_position: threes(&held_position),
                orient: threes(g_orient),
                fingers: threes(g_fingers),
                position: threes(g_position),
                rotations: turned.as_chunks().0,
                centers: threes(centers),
                scale: scale[0],
            }),
        })
    }
}

fn loss(posed: &PosedHand<f64>, pulls: &[Vec<f64>; 3]) -> f64 {
    let values = [
        posed.orient.as_flattened(),
        posed.fingers.as_flattened(),
        posed.wrist.as_flattened(),
    ];
    let dot =
        |(values, pulls): (&&[f64], &Vec<f64>)| values.iter().zip(pulls).map(|(a, b)| a * b).sum::<f64>();
    values.iter().zip(pulls).map(dot).sum()
}

#[test]
fn gradients_are_finite_differences() {
    let pulls = [random(60, 27), random(61, 54), random(62, 9)];
    for mirrored in [false, true] {
        let mut inputs = Inputs::random();
        let found = inputs.with(mirrored, |poses| {
            poses.vjp(PosePulls {
                orient: Some(pulls[0].as_chunks().0),
                fingers: Some(pulls[1].as_chunks().0),
                wrist: Some(pulls[2].as_chunks().0),
            })
        });
        let found = found.unwrap();
        let held = found.held.unwrap();
        let gradients = [
            found.orient.into_flattened(),
            found.fingers.into_flattened(),
            found.bias.into_flattened(),
            found.ray.into_flattened(),
            found.log_depth,
            held.orient.into_flattened(),
            held.fingers.into_flattened(),
            held.position.into_flattened(),
            held.rotations.into_flattened(),
            held.centers.into_flattened(),
            vec![held.scale],
        ];
        for (which, gradient) in gradients.iter().enumerate() {
            assert_eq!(gradient.len(), inputs.0[which].len());
            for (i, &gradient) in gradient.iter().enumerate() {
                let mut at = |by: f64| {
                    let before = inputs.0[which][i];
                    inputs.0[which][i] = before + by;
                    let value = inputs.with(mirrored, |poses| loss(&poses.pose().unwrap(), &pulls));
                    inputs.0[which][i] = before;
                    value
                };
                let expected = (at(H) - at(-H)) / (2.0 * H);
                assert!(
                    (gradient - expected).abs() < 1e-7 * (1.0 + expected.abs()),
                    "input {which}, {i}: {gradient} and {expected}"
                );
            }
        }
    }
}

#[test]
fn the_object_carries_a_hand_that_holds_it_rigidly() {
    let inputs = Inputs::random();
    inputs.with(false, |poses| {
        let rigid = HandPoses {
            held: poses.held.map(|held| Held { slack: 0.0, ..held }),
            ..*poses
        };
        let (posed, held) = (rigid.pose().unwrap(), poses.held.unwrap());
        // Frame 2, which is asked for twice, belongs to grasp 0: its wrist stays in the object's frame.
        for at in [0, 2] {
            let (r, c) = (held.rotations[at], held.centers[at]);
            let away: [f64; 3] = std::array::from_fn(|i| posed.wrist[at][i] - c[i]);
            for j in 0..3 {
                let own = (0..3).map(|i| r[3 * i + j] * away[i]).sum::<f64>() / held.scale;
                let place = held.base_position[0][j] + held.position[0][j];
                assert!((own - place).abs() < 1e-12);
            }
        }
    });
}

#[test]
fn what_does_not_fit_is_refused() {
    let refused = |change: &dyn Fn(&mut HandPoses<'_, f64>)| {
        Inputs::random().with(false, |poses| {
            let mut wrong = *poses;
            change(&mut wrong);
            wrong.pose().unwrap_err().to_string()
        })
    };
    assert!(refused(&|poses| poses.frames = &[CLIP]).starts_with("frames"));
    assert!(refused(&|poses| poses.start.log_depth = &[]).starts_with("base_log_depth"));
    let numbers = |poses: &mut HandPoses<'_, f64>| {
        if let Some(held) = &mut poses.held {
            held.of_frame = &[0, 1, 2];
        }
    };
    assert!(refused(&numbers).starts_with("of_frame"));
}

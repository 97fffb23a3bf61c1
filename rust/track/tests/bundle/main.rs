//! Bundle adjustment against plain loops over dense matrices, with derivatives that are differences.

mod world;

use bigs_track::{Equations, Reduced, Scene, Sightings, System};

use crate::world::{SIGMA, World, dense, eliminated};

const DAMPING: f64 = 0.01;

fn equations(system: &System) -> Equations<'_> {
    Equations {
        poses: &system.poses,
        pose_gradient: &system.pose_gradient,
        points: &system.points,
        point_gradient: &system.point_gradient,
        couplings: &system.couplings,
    }
}

fn assert_near(found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len());
    let size = expected.iter().fold(0.0f64, |size, value| size.max(value.abs()));
    for (a, b) in found.iter().zip(expected) {
        assert!((a - b).abs() <= tolerance * size, "{a} {b} of {size}");
    }
}

#[test]
fn equations_are_those_of_plain_loops() {
    for (frames, points, share) in [(11, 40, 0.5), (6, 60, 1.0), (2, 5, 1.0)] {
        let world = World::random(frames, points, share);
        let seen = world.sightings();
        let own = 6 * seen.moving();
        let mut dense = dense(&world);
        let system = seen.linearise(&world.scene()).unwrap();
        let flat: Vec<f64> = dense.matrix[..own]
            .iter()
            .flat_map(|row| row[..own].to_vec())
            .collect();
        assert_near(&system.poses, &flat, 1e-7);
        let all = [&system.pose_gradient[..], system.point_gradient.as_flattened()].concat();
        assert_near(&all, &dense.gradient[..own + 3 * points], 1e-7);

        let end = own + 3 * points;
        for (i, row) in dense.matrix[..end].iter_mut().enumerate() {
            row[i] *= 1.0 + DAMPING;
        }
        let end_gradient = dense.gradient.clone();
        let points_matrix = dense.matrix.clone();
        let expected = eliminated(dense, own, end);
        let reduced = seen.reduce(&equations(&system), DAMPING).unwrap();
        let flat: Vec<f64> = expected.matrix[..own]
            .iter()
            .flat_map(|row| row[..own].to_vec())
            .collect();
        assert_near(&reduced.matrix, &flat, 1e-7);
        assert_near(&reduced.gradient, &expected.gradient[..own], 1e-6);

        // Points follow any change of the poses so that their own equations hold.
        let mut rng = fastrand::Rng::with_seed(1);
        let change: Vec<[f64; 6]> = (0..seen.moving())
            .map(|_| std::array::from_fn(|_| 0.01 * rng.f64()))
            .collect();
        let steps = seen
            .point_steps(
                &system.couplings,
                &system.point_gradient,
                &reduced.inverses,
                &change,
            )
            .unwrap();
        let whole = [change.as_flattened(), steps.as_flattened()].concat();
        for i in own..end {
            let dot = |row: &[f64]| -> f64 { row.iter().zip(&whole).map(|(a, b)| a * b).sum() };
            let size: f64 = points_matrix[i][i] * 0.1;
            assert!((dot(&points_matrix[i]) + end_gradient[i]).abs() < 1e-6 * size);
        }
    }
}

#[test]
fn the_focal_length_s_part_is_that_of_plain_loops() {
    let world = World::random(7, 30, 0.6);
    let seen = world.sightings();
    let (own, end) = (6 * seen.moving(), 6 * seen.moving() + 90);
    let dense = dense(&world);
    let border = seen.border(&world.scene()).unwrap();
    assert_near(&border.poses, &dense.matrix[end][..own], 1e-7);
    assert_near(border.points.as_flattened(), &dense.matrix[end][own..end], 1e-7);
    assert_near(&[border.stiffness], &[dense.matrix[end][end]], 1e-7);
    assert!((border.gradient - dense.gradient[end]).abs() < 1e-6 * border.stiffness);
    // Also what points carry over to the poses, here the same column once more.
    let system = seen.linearise(&world.scene()).unwrap();
    let carried = seen.carried(&system.couplings, &border.points).unwrap();
    let expected: Vec<f64> = dense.matrix[..own]
        .iter()
        .map(|row| (own..end).map(|j| row[j] * dense.matrix[end][j]).sum())
        .collect();
    assert_near(&carried, &expected, 1e-6);
}

#[test]
fn a_cost_is_the_sum_of_losses() {
    let world = World::random(9, 400, 0.7);
    let expected: f64 = (0..world.frame.len())
        .map(|row| {
            let at = world.project(world.frame[row] as usize, world.point[row] as usize, &[0.0; 10]);
            let [x, y] = [0, 1].map(|i| at[i] - world.pixels[row][i]);
            let [xx, xy, yy] = world.precision[row];
            ((xx * x * x + 2.0 * xy * x * y + yy * y * y) / (SIGMA * SIGMA)).ln_1p()
        })
        .sum();
    let found = world.sightings().cost(&world.scene()).unwrap();
    assert!((found - expected).abs() < 1e-10 * expected);
}

/// Everything that is computed of a world.
fn everything(world: &World) -> (f64, System, Reduced, Vec<[f64; 3]>, Vec<f64>) {
    let (seen, scene) = (world.sightings(), world.scene());
    let system = seen.linearise(&scene).unwrap();
    let reduced = seen.reduce(&equations(&system), DAMPING).unwrap();
    let change = vec![[0.01; 6]; seen.moving()];
    let steps = seen
        .point_steps(
            &system.couplings,
            &system.point_gradient,
            &reduced.inverses,
            &change,
        )
        .unwrap();
    let border = seen.border(&scene).unwrap();
    let carried = seen.carried(&system.couplings, &border.points).unwrap();
    let numbers = [&carried[..], &border.poses, border.points.as_flattened()].concat();
    (seen.cost(&scene).unwrap(), system, reduced, steps, numbers)
}

#[test]
fn many_pieces_and_rounds_are_the_sum_of_their_parts() {
    let world = World::random(10, 2500, 0.6);
    assert!(world.frame.len() > 3 * 2048);
    let whole = everything(&world);
    let mut matrix = vec![0.0; whole.1.poses.len()];
    let mut gradient = vec![0.0; whole.1.pose_gradient.len()];
    // What points carry to the poses, and the focal length's coupling with these.
    let mut carried = vec![0.0; 2 * gradient.len()];
    for first in (0..2500).step_by(250) {
        let own = |point: &i64| (first..first + 250).contains(&(*point as usize));
        let rows: Vec<usize> = (0..world.point.len())
            .filter(|&row| own(&world.point[row]))
            .collect();
        let part = World {
            points: world.points[first..first + 250].to_vec(),
            frame: rows.iter().map(|&row| world.frame[row]).collect(),
            point: rows.iter().map(|&row| world.point[row] - first as i64).collect(),
            pixels: rows.iter().map(|&row| world.pixels[row]).collect(),
            precision: rows.iter().map(|&row| world.precision[row]).collect(),
            ..world.clone()
        };
        let (_, system, reduced, _, numbers) = everything(&part);
        for (sum, value) in matrix.iter_mut().zip(&reduced.matrix) {
            *sum += value;
        }
        for (sum, value) in gradient.iter_mut().zip(&reduced.gradient) {
            *sum += value;
        }
        for (sum, value) in carried.iter_mut().zip(&numbers) {
            *sum += value;
        }
        assert!(
            system.points[..] == whole.1.points[first..first + 250],
            "a point's equations are its own"
        );
    }
    assert_near(&whole.2.matrix, &matrix, 1e-10);
    assert_near(&whole.2.gradient, &gradient, 1e-10);
    assert_near(&whole.4[..carried.len()], &carried, 1e-10);
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let world = World::random(10, 2500, 0.6);
    let within = |threads: usize| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap()
            .install(|| everything(&world))
    };
    assert!(within(1) == within(3));
}

#[test]
fn nothing_seen_and_nothing_that_moves_is_no_error() {
    let mut world = World::random(6, 20, 0.5);
    world.free = vec![false; 6];
    let (cost, system, reduced, steps, _) = everything(&world);
    assert!(cost > 0.0 && system.poses.is_empty() && reduced.gradient.is_empty());
    assert!(steps.as_flattened().iter().all(|step| step.is_finite()));
    world.free = vec![true; 6];
    world.points.clear();
    (world.frame, world.point, world.pixels, world.precision) = (vec![], vec![], vec![], vec![]);
    let (cost, system, reduced, ..) = everything(&world);
    assert_eq!((cost, system.pose_gradient), (0.0, vec![0.0; 36]));
    assert_eq!(reduced.matrix.iter().filter(|value| **value == 1e-9).count(), 36);
    (world.rotations, world.transl, world.free) = (vec![], vec![], vec![]);
    assert_eq!(everything(&world).0, 0.0);
}

#[test]
fn values_that_are_no_numbers_go_through() {
    for odd in [f64::NAN, f64::INFINITY, -1e300, 0.0] {
        for what in 0..5 {
            let mut world = World::random(6, 20, 0.7);
            match what {
                0 => world.points[3] = [odd; 3],
                1 => world.rotations[2] = [odd; 9],
                2 => world.transl[2] = [odd; 3],
                3 => world.pixels[5] = [odd; 2],
                _ => world.precision[5] = [odd; 3],
            }
            let (_, system, ..) = everything(&world);
            // Points that it has nothing to do with are as before.
            if what != 1 && what != 2 {
                assert!(system.points[19].iter().all(|value| value.is_finite()));
            }
        }
    }
}

#[test]
fn indices_and_lengths_that_do_not_fit_are_refused() {
    let world = World::random(4, 3, 1.0);
    let refused = |change: &dyn Fn(&mut World)| {
        let mut world = world.clone();
        change(&mut world);
        Sightings::new(
            &world.frame,
            &world.point,
            world.pixels,
            world.precision,
            &world.free,
        )
        .unwrap_err()
        .to_string()
    };
    let last = world.frame.len();
    assert_eq!(
        [
            refused(&|world| world.frame[1] = 4),
            refused(&|world| world.frame[1] = -1),
            refused(&|world| world.frame[0] = 2),
            refused(&|world| world.point[0] = -1),
            refused(&|world| world.point[0] = i64::MIN),
            refused(&|world| world.point[last - 1] = i64::MAX),
            refused(&|world| world.point[last - 1] = 1),
            refused(&|world| world.free.clear()),
            refused(&|world| world.point.push(0)),
            refused(&|world| world.pixels.clear()),
        ],
        [
            "frame: expected 0 to 3, found 4".to_string(),
            "frame: expected 0 to 3, found -1".into(),
            "frame: expected a point's in order, here 2 or more, found 1".into(),
            "point: expected ranks in order, here 0 at most, found -1".into(),
            format!(
                "point: expected ranks in order, here 0 at most, found {}",
                i64::MIN
            ),
            format!(
                "point: expected ranks in order, here 3 at most, found {}",
                i64::MAX
            ),
            "point: expected ranks in order, here 3 at most, found 1".into(),
            "frame: expected 0 to -1, found 0".into(),
            format!("point: expected {last} values, found {}", last + 1),
            format!("pixels: expected {last} values, found 0"),
        ]
    );
    let seen = world.sightings();
    let short = Scene {
        transl: &world.transl[1..],
        ..world.scene()
    };
    assert_eq!(
        seen.cost(&short).unwrap_err().to_string(),
        "transl: expected 4 values, found 3"
    );
    assert!(seen.linearise(&short).is_err() && seen.border(&short).is_err());
    let system = seen.linearise(&world.scene()).unwrap();
    let whole = equations(&system);
    for wrong in [
        Equations { poses: &[], ..whole },
        Equations {
            pose_gradient: &[],
            ..whole
        },
        Equations { points: &[], ..whole },
        Equations {
            point_gradient: &[],
            ..whole
        },
        Equations {
            couplings: &[],
            ..whole
        },
    ] {
        assert!(seen.reduce(&wrong, 0.0).is_err());
    }
    assert!(seen.carried(&system.couplings[1..], &world.points).is_err());
    assert!(seen.carried(&system.couplings, &world.points[1..]).is_err());
    let (couplings, gradient, inverses) = (&system.couplings, &system.point_gradient, &system.points);
    let change = vec![[0.0; 6]; seen.moving()];
    assert!(
        seen.point_steps(&couplings[1..], gradient, inverses, &change)
            .is_err()
    );
    assert!(
        seen.point_steps(couplings, &gradient[1..], inverses, &change)
            .is_err()
    );
    assert!(
        seen.point_steps(couplings, gradient, &inverses[1..], &change)
            .is_err()
    );
    assert!(
        seen.point_steps(couplings, gradient, inverses, &change[1..])
            .is_err()
    );
}

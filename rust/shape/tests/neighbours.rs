//! Nearest points against a look at all of them.

use bigs_shape::{Neighbours, Vec3};

fn cloud(rng: &mut fastrand::Rng, count: usize) -> Vec<Vec3> {
    (0..count)
        .map(|_| std::array::from_fn(|_| 2.0 * rng.f64() - 1.0))
        .collect()
}

fn distance(a: Vec3, b: Vec3) -> f64 {
    let away = [0, 1, 2].map(|i| a[i] - b[i]);
    (away[0] * away[0] + away[1] * away[1] + away[2] * away[2]).sqrt()
}

#[test]
fn the_nearest_is_found_with_any_guess() {
    let mut rng = fastrand::Rng::with_seed(1);
    for count in [1, 2, 9, 700] {
        let mut points = cloud(&mut rng, count);
        // A plane of equal coordinates, and points that come twice.
        for i in 0..count / 3 {
            points[i][2] = 0.25;
            points[count - 1 - i] = points[i];
        }
        let mut places = cloud(&mut rng, 900);
        places.extend(points.iter().copied());
        places.push([40.0, -3.0, 0.25]);
        let guesses: Vec<u32> = places.iter().map(|_| rng.u32(0..count as u32)).collect();
        let tree = Neighbours::new(points.clone()).unwrap();
        let (distances, indices) = tree.of(&places, None).unwrap();
        let (guessed, from_guesses) = tree.of(&places, Some(&guesses)).unwrap();
        assert_eq!(distances, guessed);
        for (at, &place) in places.iter().enumerate() {
            let least = points
                .iter()
                .map(|&point| distance(point, place))
                .fold(f64::INFINITY, f64::min);
            assert_eq!(distances[at], least);
            for index in [indices[at], from_guesses[at]] {
                assert_eq!(distance(points[index as usize], place), least);
            }
        }
    }
}

#[test]
fn what_is_not_finite_is_infinitely_far() {
    let tree = Neighbours::new(vec![[0.0; 3], [1.0; 3]]).unwrap();
    let places = [[f64::NAN, 0.0, 0.0], [0.0, f64::INFINITY, 0.0], [0.9; 3]];
    for guesses in [None, Some(&[1, 1, 0][..])] {
        let (distances, indices) = tree.of(&places, guesses).unwrap();
        assert_eq!(distances[..2], [f64::INFINITY; 2]);
        assert_eq!(indices[2], 1);
    }
}

#[test]
fn bad_input_is_refused() {
    assert!(Neighbours::new(Vec::new()).is_err());
    let tree = Neighbours::new(vec![[0.0; 3]]).unwrap();
    assert!(tree.of(&[[0.0; 3]], Some(&[])).is_err());
    assert!(tree.of(&[[0.0; 3]], Some(&[1])).is_err());
}

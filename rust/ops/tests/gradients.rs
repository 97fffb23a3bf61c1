//! Gradients of pictures' terms, joint trees and costs of fingers against finite differences, and refusals.

use bigs_ops::fingers::{Costs, Fingers};
use bigs_ops::joints::{Tree, rotations, rotations_vjp};
use bigs_ops::pixels::{Frames, alone, together::Together};

const H: f64 = 1e-6;

fn random(seed: u64, count: usize) -> Vec<f64> {
    let mut random = fastrand::Rng::with_seed(seed);
    (0..count).map(|_| random.f64()).collect()
}

/// Holds gradients against central differences of a loss.
fn check(name: &str, found: &[f64], loss: &dyn Fn(usize, f64) -> f64) {
    for (i, &found) in found.iter().enumerate() {
        let expected = (loss(i, H) - loss(i, -H)) / (2.0 * H);
        assert!(
            (found - expected).abs() < 1e-7 * (1.0 + expected.abs()),
            "{name} {i}: {found} and {expected}"
        );
    }
}

fn changed(values: &[f64], at: usize, by: f64) -> Vec<f64> {
    let mut values = values.to_vec();
    values[at] += by;
    values
}

fn threes(flat: &[f64]) -> &[[f64; 3]] {
    flat.as_chunks().0
}

fn nines(flat: &[f64]) -> &[[f64; 9]] {
    flat.as_chunks().0
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

const PIXELS: usize = 70;
const CLIP: usize = 4;
const SHOWN: [usize; 2] = [3, 1];

fn frames() -> Frames<'static> {
    Frames {
        frames: &SHOWN,
        pixels: PIXELS,
        clip: CLIP,
    }
}

#[test]
fn pictures_of_all_subjects() {
    let clip = CLIP * PIXELS;
    let (images, foreground, unknown) = (random(1, 3 * clip), random(2, clip), random(3, clip));
    let shares = [random(4, clip), random(5, clip)];
    let (colors, alphas) = (random(6, 2 * PIXELS * 5), random(7, 2 * PIXELS));
    let weights = [0.7, 3.0, 1.3, 0.4];
    let with = |colors: &[f64], alphas: &[f64]| {
        let together = Together {
            frames: frames(),
            colors,
            channels: 5,
            alphas,
            images: &images,
            foreground: &foreground,
            unknown: &unknown,
            shares: shares.iter().map(Vec::as_slice).collect(),
            covered: 0.5,
        };
        let terms = together.terms().unwrap();
        (terms, together.vjp(&terms, weights).unwrap())
    };
    let (terms, (v_colors, v_alphas)) = with(&colors, &alphas);
    assert!(terms.values.iter().all(|&value| value > 0.0) && terms.foreground < 2.0 * PIXELS as f64);
    let loss = |colors: &[f64], alphas: &[f64]| dot(&with(colors, alphas).0.values, &weights);
    check("colors", &v_colors, &|i, h| {
        loss(&changed(&colors, i, h), &alphas)
    });
    check("alphas", &v_alphas, &|i, h| {
        loss(&colors, &changed(&alphas, i, h))
    });
}

#[test]
fn pictures_of_one_subject() {
    let clip = CLIP * PIXELS;
    let (images, own) = (random(1, 3 * clip), random(2, clip));
    let hidden: Vec<f64> = random(3, clip).iter().map(|v| 0.3 * v).collect();
    let (colors, alphas) = (random(6, 2 * PIXELS * 3), random(7, 2 * PIXELS));
    let weights = [0.7, 3.0, 1.3];
    let masks = (&own[..], &hidden[..]);
    fn covered<'a>(alphas: &'a [f64], (own, hidden): (&'a [f64], &'a [f64])) -> alone::Outline<'a, f64> {
        alone::Outline {
            frames: frames(),
            alphas,
            own,
            hidden,
        }
    }
    let with = |colors: Option<&[f64]>, alphas: &[f64]| {
        let alone = alone::Alone {
            outline: covered(alphas, masks),
            colors,
            images: &images,
        };
        let terms = alone.terms().unwrap();
        (terms, alone.vjp(&terms, weights).unwrap())
    };
    let (terms, (v_colors, v_alphas)) = with(Some(&colors), &alphas);
    let loss = |colors: &[f64], alphas: &[f64]| dot(&with(Some(colors), alphas).0.values, &weights);
    check("colors", &v_colors, &|i, h| {
        loss(&changed(&colors, i, h), &alphas)
    });
    check("alphas", &v_alphas, &|i, h| {
        loss(&colors, &changed(&alphas, i, h))
    });
    let (outline, (none, v_outline)) = with(None, &alphas);
    assert_eq!(outline.values, [0.0, 0.0, terms.values[2]]);
    assert!(none.is_empty() && v_outline == v_alphas);

    // The same picture by picture.
    let each = covered(&alphas, masks).squares().unwrap();
    let area = terms.own;
    assert!((each.iter().sum::<f64>() / area - terms.values[2]).abs() < 1e-12 * terms.values[2]);
    let pulls = covered(&alphas, masks).squares_vjp(&[2.0, -0.5]).unwrap();
    check("coverage", &pulls, &|i, h| {
        dot(
            &covered(&changed(&alphas, i, h), masks).squares().unwrap(),
            &[2.0, -0.5],
        )
    });
    assert!(covered(&alphas, masks).squares_vjp(&[1.0]).is_err());
}

#[test]
fn frames_that_the_clip_does_not_have_are_refused() {
    let values = vec![0f32; 2 * PIXELS];
    let outline = alone::Outline {
        frames: Frames {
            frames: &[0, 2],
            pixels: PIXELS,
            clip: 2,
        },
        alphas: &values,
        own: &values,
        hidden: &values,
    };
    let alone = alone::Alone {
        outline,
        colors: None,
        images: &[],
    };
    assert!(alone.terms().unwrap_err().to_string().starts_with("frames"));
    assert!(outline.squares().unwrap_err().to_string().starts_with("frames"));
}

#[test]
fn rotation_vectors_of_every_length() {
    for angle in [0.0, 1e-9, 1e-3, 0.049, 0.051, 1.0, std::f64::consts::PI] {
        let vectors: Vec<f64> = random(8, 9).iter().map(|v| angle * (2.0 * v - 1.0)).collect();
        let v = random(9, 27);
        let loss = |vectors: &[f64]| dot(rotations(threes(vectors)).as_flattened(), &v);
        let found = rotations_vjp(threes(&vectors), nines(&v)).unwrap();
        check("vectors", found.as_flattened(), &|i, h| {
            loss(&changed(&vectors, i, h))
        });
        for matrix in rotations(threes(&vectors)) {
            let [a, b, c] = [0, 1, 2].map(|i| [matrix[i], matrix[3 + i], matrix[6 + i]]);
            assert!((dot(&a, &a) - 1.0).abs() < 1e-14 && dot(&b, &c).abs() < 1e-14);
        }
    }
}

#[test]
fn joint_trees() {
    let parents = [0, 0, 1, 0, 3];
    let turns = rotations(threes(&random(1, 30))).as_flattened().to_vec();
    let (rest, root) = (random(2, 15), random(3, 6));
    let (v_joints, v_bones) = (random(4, 30), random(5, 160));
    // The last row is constant.
    let v_bones: Vec<f64> = v_bones
        .iter()
        .enumerate()
        .map(|(i, v)| if i % 16 < 12 { *v } else { 0.0 })
        .collect();
    for rest in [rest.clone(), [rest.clone(), random(6, 15)].concat()] {
        let tree = |turns: &[f64], rest: &[f64], root: &[f64]| {
            let tree = Tree {
                parents: &parents,
                rotations: nines(turns),
                rest: threes(rest),
                root: threes(root),
            };
            let posed = tree.pose().unwrap();
            let gradients = tree.vjp(Some(threes(&v_joints)), Some(v_bones.as_chunks().0));
            let loss =
                dot(posed.joints.as_flattened(), &v_joints) + dot(posed.bones.as_flattened(), &v_bones);
            (loss, gradients.unwrap())
        };
        let (_, found) = tree(&turns, &rest, &root);
        check("rotations", found.rotations.as_flattened(), &|i, h| {
            tree(&changed(&turns, i, h), &rest, &root).0
        });
        check("rest", found.rest.as_flattened(), &|i, h| {
            tree(&turns, &changed(&rest, i, h), &root).0
        });
        check("root", found.root.as_flattened(), &|i, h| {
            tree(&turns, &rest, &changed(&root, i, h)).0
        });
    }
    let backwards = Tree {
        parents: &[0, 2, 0],
        rotations: nines(&turns[..27]),
        rest: threes(&rest[..9]),
        root: threes(&root[..3]),
    };
    assert!(backwards.pose().unwrap_err().to_string().starts_with("parents"));
}

#[test]
fn costs_of_fingers() {
    let turns = rotations(threes(&random(1, 90))).as_flattened().to_vec();
    let signed = |seed, count| -> Vec<f64> { random(seed, count).iter().map(|v| 2.0 * v - 1.0).collect() };
    let (impossible, bends) = (signed(2, 3 * 135), signed(3, 16 * 135));
    let v = Costs {
        unevenness: 0.7,
        impossible: -0.2,
        uncoupled: 1.3,
    };
    let fingers = |turns: &[f64]| {
        let fingers = Fingers {
            rotations: nines(turns),
            impossible: nines(&impossible),
            bends: nines(&bends),
        };
        let costs = fingers.costs().unwrap();
        let loss =
            v.unevenness * costs.unevenness + v.impossible * costs.impossible + v.uncoupled * costs.uncoupled;
        (loss, fingers.vjp(v).unwrap())
    };
    let (_, found) = fingers(&turns);
    check("hand_pose", found.as_flattened(), &|i, h| {
        fingers(&changed(&turns, i, h)).0
    });
    let short = Fingers {
        rotations: nines(&turns[..9]),
        impossible: nines(&impossible),
        bends: nines(&bends),
    };
    assert!(short.costs().unwrap_err().to_string().starts_with("hand_pose"));
}

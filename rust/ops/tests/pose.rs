//! Gradients of posing against finite differences, the same bits for any number of threads, and refusals.

use bigs_ops::pose::{Ambient, Light, Pose, PosedGaussians, Subject, Surface, Wanted};

const FRAMES: usize = 2;
const BONES: usize = 3;
const PARTS: usize = 2;

/// Everything a subject is made of, N Gaussians.
#[derive(Clone)]
struct Owned {
    count: usize,
    mirrored: bool,
    points: Vec<[f64; 3]>,
    weights: Vec<f64>,
    bones: Vec<f64>,
    quats: Vec<[f64; 4]>,
    albedo: Vec<[f64; 3]>,
    parts: Vec<f64>,
    shade: Vec<f64>,
    occlusion: Vec<f64>,
    strength: [f64; 3],
}

fn owned(seed: u64, count: usize, moving: bool, mirrored: bool) -> Owned {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut next = move || 2.0 * random.f64() - 1.0;
    let mut bones = Vec::new();
    for _ in 0..FRAMES * BONES {
        // A turn about some axis, by Rodrigues' formula, and a translation.
        let axis = [next(), next(), next()];
        let length = axis.iter().map(|a| a * a).sum::<f64>().sqrt();
        let [x, y, z] = axis.map(|a| a / length);
        let (s, c) = (3.0 * next()).sin_cos();
        let k = 1.0 - c;
        bones.extend([c + x * x * k, x * y * k - z * s, x * z * k + y * s, next()]);
        bones.extend([y * x * k + z * s, c + y * y * k, y * z * k - x * s, next()]);
        bones.extend([z * x * k - y * s, z * y * k + x * s, c + z * z * k, next()]);
    }
    let rows = if moving { FRAMES * count } else { count };
    Owned {
        count,
        mirrored,
        points: (0..rows).map(|_| [next(), next(), next()]).collect(),
        weights: (0..count * BONES).map(|_| 1.5 + next()).collect(),
        bones,
        quats: (0..count).map(|_| [next(), next(), next(), next()]).collect(),
        albedo: (0..count).map(|_| [next(), next(), next()]).collect(),
        parts: (0..count * PARTS).map(|_| next()).collect(),
        shade: (0..FRAMES * (4 + PARTS)).map(|_| 0.3 * next()).collect(),
        occlusion: (0..FRAMES * count).map(|_| 0.5 + 0.5 * next()).collect(),
        strength: [next(), next(), next()],
    }
}

fn subject(own: &Owned) -> Subject<'_, f64> {
    Subject {
        count: own.count,
        points: &own.points,
        weights: &own.weights,
        bones: &own.bones,
        bone_size: 12,
        mirrored: own.mirrored,
        surface: Some(Surface {
            quats: &own.quats,
            albedo: &own.albedo,
            light: Some(Light {
                parts_each: PARTS,
                parts: &own.parts,
                shade: &own.shade,
                ambient: Some(Ambient {
                    occlusion: &own.occlusion,
                    strength: own.strength,
                }),
            }),
        }),
    }
}

fn clip() -> [[f64; 3]; 8] {
    std::array::from_fn(|b| std::array::from_fn(|c| 0.1 * (3 * b + c) as f64 - 1.0))
}

fn posed(all: &[Owned], clip: &[[f64; 3]; 8]) -> PosedGaussians<f64> {
    let subjects = all.iter().map(subject).collect();
    Pose::new(FRAMES, subjects, Some(clip), true)
        .unwrap()
        .forward()
        .unwrap()
}

/// The gradient of a loss, a fixed sum of everything.
fn pulls(like: &PosedGaussians<f64>) -> PosedGaussians<f64> {
    let mut random = fastrand::Rng::with_seed(77);
    let mut next = move |_: usize| 2.0 * random.f64() - 1.0;
    PosedGaussians {
        means: like.means.iter().map(|_| [0, 1, 2].map(&mut next)).collect(),
        quats: like.quats.iter().map(|_| [0, 1, 2, 3].map(&mut next)).collect(),
        colors: like.colors.iter().map(|_| next(0)).collect(),
    }
}

fn loss(all: &[Owned], clip: &[[f64; 3]; 8], pulls: &PosedGaussians<f64>) -> f64 {
    let posed = posed(all, clip);
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    dot(posed.means.as_flattened(), pulls.means.as_flattened())
        + dot(posed.quats.as_flattened(), pulls.quats.as_flattened())
        + dot(&posed.colors, &pulls.colors)
}

const ALL: Wanted = Wanted {
    points: true,
    weights: true,
    bones: true,
    quats: true,
    albedo: true,
    light: true,
};

#[test]
fn gradients_are_finite_differences() {
    let all = [owned(1, 5, true, true), owned(2, 4, false, false)];
    let clip = clip();
    let pulls = pulls(&posed(&all, &clip));
    let pose = Pose::new(FRAMES, all.iter().map(subject).collect(), Some(&clip), true).unwrap();
    let found = pose
        .vjp(
            Some(&pulls.means),
            Some(&pulls.quats),
            Some(&pulls.colors),
            &[ALL; 2],
        )
        .unwrap();
    let h = 1e-6;
    let check = |name: &str, found: &[f64], change: &dyn Fn(usize, f64) -> f64| {
        for (i, &found) in found.iter().enumerate() {
            let expected = (change(i, h) - change(i, -h)) / (2.0 * h);
            assert!(
                (found - expected).abs() < 1e-7 * (1.0 + expected.abs()),
                "{name} {i}: {found} and {expected}"
            );
        }
    };
    for (index, own) in found.subjects.iter().enumerate() {
        let with = |edit: &dyn Fn(&mut Owned)| {
            let mut changed = all.clone();
            edit(&mut changed[index]);
            loss(&changed, &clip, &pulls)
        };
        check("points", own.points.as_flattened(), &|i, h| {
            with(&|s| s.points.as_flattened_mut()[i] += h)
        });
        check("weights", &own.weights, &|i, h| with(&|s| s.weights[i] += h));
        check("bones", &own.bones, &|i, h| with(&|s| s.bones[i] += h));
        check("quats", own.quats.as_flattened(), &|i, h| {
            with(&|s| s.quats.as_flattened_mut()[i] += h)
        });
        check("albedo", own.albedo.as_flattened(), &|i, h| {
            with(&|s| s.albedo.as_flattened_mut()[i] += h)
        });
        check("shade", &own.shade, &|i, h| with(&|s| s.shade[i] += h));
        check("strength", &own.strength, &|i, h| with(&|s| s.strength[i] += h));
    }
    check("clip", found.clip.as_flattened(), &|i, h| {
        let mut changed = clip;
        changed.as_flattened_mut()[i] += h;
        loss(&all, &changed, &pulls)
    });
}

#[test]
fn threads_change_no_bit() {
    let all = [owned(3, 700, false, true), owned(4, 300, true, false)];
    let clip = clip();
    let run = || {
        let subjects = all.iter().map(subject).collect();
        let pose = Pose::new(FRAMES, subjects, Some(&clip), false).unwrap();
        let posed = pose.forward().unwrap();
        let pulls = pulls(&posed);
        let found = pose.vjp(Some(&pulls.means), None, Some(&pulls.colors), &[ALL; 2]);
        (posed, found.unwrap())
    };
    let [one, four] = [1, 4].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(run)
    });
    assert!(one == four);
}

#[test]
fn nothing_is_posed_to_nothing() {
    let none = Subject {
        count: 0,
        points: &[],
        weights: &[],
        bones: &[0.0; 3 * 12],
        bone_size: 12,
        mirrored: false,
        surface: None::<Surface<'_, f32>>,
    };
    let pose = Pose::new(3, vec![none], None, false).unwrap();
    assert!(pose.forward().unwrap().means.is_empty());
    let found = pose.vjp(None, None, None, &[ALL]).unwrap();
    assert!(found.subjects[0].points.is_empty() && found.clip == [[0.0; 3]; 8]);
    assert_eq!(found.subjects[0].bones, vec![0.0; 3 * 12]);
}

#[test]
fn what_does_not_fit_is_named() {
    let own = owned(5, 6, false, false);
    let refuse = |edit: &dyn Fn(&mut Subject<'_, f64>)| {
        let mut subject = subject(&own);
        edit(&mut subject);
        Pose::new(FRAMES, vec![subject], Some(&clip()), false)
            .unwrap_err()
            .to_string()
    };
    assert!(refuse(&|s| s.points = &s.points[..4]).starts_with("points: expected 12"));
    assert!(refuse(&|s| s.weights = &s.weights[..4]).starts_with("weights: expected 18"));
    assert!(refuse(&|s| s.bones = &s.bones[..30]).starts_with("bones: expected 24"));
    assert!(refuse(&|s| s.bones = &s.bones[..24]).starts_with("weights: expected 6"));
    assert!(refuse(&|s| s.bone_size = 9).starts_with("bones: expected 16"));
    let missing = Pose::new(FRAMES, vec![subject(&own)], None, false).unwrap_err();
    assert!(missing.to_string().starts_with("clip: expected 8"));
}

//! How much of the sky above points of a surface other surfaces cover, which stand there as small discs.

use bigs_raster::{Simd, SimdLevel, Vectors, Work, filled_with};
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;
use crate::lanes::{LONGEST, Lanes};

/// Points are never nearer to a disc than this, in square metres: a point of a surface may be a disc of the same one.
const LEAST_SQUARED_DISTANCE: f64 = 1e-12;

/// Places with their unit normals, as many in each of B frames.
#[derive(Clone, Copy, Debug)]
pub struct Places<'a, T> {
    /// B × N, metres.
    pub points: &'a [[T; 3]],
    /// B × N, outwards.
    pub normals: &'a [[T; 3]],
}

/// M discs in each of B frames.
#[derive(Clone, Copy, Debug)]
pub struct Discs<'a, T> {
    /// B × M.
    pub places: Places<'a, T>,
    /// M, square metres.
    pub areas: &'a [T],
}

/// The form factors of discs summed at every place, B × N: the share of a place's light, weighted by the cosine at which
/// it comes, that each disc takes if no other is in the way. Only discs that face the place count. The sum may exceed 1
/// where one disc hides another.
///
/// # Errors
/// Lengths that do not fit, or a level that this machine does not have.
pub fn form_factors<T: Vectors>(
    frames: usize,
    places: &Places<'_, T>,
    discs: &Discs<'_, T>,
) -> Result<Vec<T>, OpsError> {
    let level = SimdLevel::chosen()?;
    let each = places.points.len() / frames.max(1);
    let count = discs.areas.len();
    check_length("points", frames * each, places.points.len())?;
    check_length("normals", frames * each, places.normals.len())?;
    check_length("disc points", frames * count, discs.places.points.len())?;
    check_length("disc normals", frames * count, discs.places.normals.len())?;
    let mut sums = filled_with("form factors", T::ZERO, &[frames, each])?;
    if each > 0 {
        sums.par_chunks_exact_mut(each)
            .enumerate()
            .for_each(|(frame, sums)| {
                level.run(Frame {
                    points: &places.points[frame * each..][..each],
                    normals: &places.normals[frame * each..][..each],
                    discs: rows(discs, frame),
                    sums,
                });
            });
    }
    Ok(sums)
}

/// x, y, z, the normal and the area of a frame's discs, with discs of no area up to whole vectors of every level.
fn rows<T: Vectors>(discs: &Discs<'_, T>, frame: usize) -> [Vec<T>; 7] {
    let count = discs.areas.len();
    let filled = count.next_multiple_of(LONGEST);
    let own = frame * count..(frame + 1) * count;
    let (points, normals) = (&discs.places.points[own.clone()], &discs.places.normals[own]);
    std::array::from_fn(|row| {
        let mut values: Vec<T> = match row {
            0..3 => points.iter().map(|point| point[row]).collect(),
            3..6 => normals.iter().map(|normal| normal[row - 3]).collect(),
            _ => discs.areas.to_vec(),
        };
        values.resize(filled, T::ZERO);
        values
    })
}

struct Frame<'a, T> {
    points: &'a [[T; 3]],
    normals: &'a [[T; 3]],
    discs: [Vec<T>; 7],
    sums: &'a mut [T],
}

impl<T: Vectors> Work for Frame<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let [xs, ys, zs, axes_x, axes_y, axes_z, areas] = &self.discs;
        let nothing = Lanes::<T, S>::zero(simd);
        let least = Lanes::splat(simd, T::of(LEAST_SQUARED_DISTANCE));
        let pi = Lanes::splat(simd, T::of(std::f64::consts::PI));
        for ((point, normal), sum) in self.points.iter().zip(self.normals).zip(self.sums) {
            let point = point.map(|value| Lanes::splat(simd, value));
            let normal = normal.map(|value| Lanes::splat(simd, value));
            let mut total = nothing;
            for at in (0..areas.len()).step_by(Lanes::<T, S>::COUNT) {
                let (x, y, z) = (
                    Lanes::load(simd, &xs[at..]) - point[0],
                    Lanes::load(simd, &ys[at..]) - point[1],
                    Lanes::load(simd, &zs[at..]) - point[2],
                );
                let squared = (x * x + y * y + z * z).max(least);
                let above = (x * normal[0] + y * normal[1] + z * normal[2]).max(nothing);
                let towards = x * Lanes::load(simd, &axes_x[at..])
                    + y * Lanes::load(simd, &axes_y[at..])
                    + z * Lanes::load(simd, &axes_z[at..]);
                let area = Lanes::load(simd, &areas[at..]);
                let taken = area * above * (-towards).max(nothing);
                total = total + taken.over(squared * pi.times_plus(squared, area));
            }
            [*sum] = Lanes::sums(&[total]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The formula, a pair at a time.
    fn plainly(point: [f64; 3], normal: [f64; 3], discs: &Discs<'_, f64>) -> f64 {
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        (0..discs.areas.len())
            .map(|m| {
                let at = discs.places.points[m];
                let away = [0, 1, 2].map(|i| at[i] - point[i]);
                let squared = dot(away, away);
                if squared == 0.0 {
                    return 0.0;
                }
                let above = dot(away, normal).max(0.0) / squared.sqrt();
                let towards = (-dot(away, discs.places.normals[m])).max(0.0) / squared.sqrt();
                discs.areas[m] * above * towards / (std::f64::consts::PI * squared + discs.areas[m])
            })
            .sum()
    }

    fn random(seed: u64, count: usize) -> (Vec<[f64; 3]>, Vec<[f64; 3]>) {
        let mut random = fastrand::Rng::with_seed(seed);
        let mut next = || 2.0 * random.f64() - 1.0;
        let points = (0..count).map(|_| [next(), next(), next()]).collect();
        let normals = (0..count)
            .map(|_| {
                let [x, y, z] = [next(), next(), next()];
                let length = (x * x + y * y + z * z).sqrt();
                [x / length, y / length, z / length]
            })
            .collect();
        (points, normals)
    }

    #[test]
    fn sums_are_the_formula_s() {
        let (points, normals) = random(1, 2 * 5);
        let (mut at, facing) = random(2, 2 * 37);
        // A disc at a point itself takes nothing.
        at[3] = points[2];
        let areas: Vec<f64> = (0..37).map(|m| 0.01 + 0.001 * f64::from(m)).collect();
        let places = Places {
            points: &points,
            normals: &normals,
        };
        let discs = |frame: usize| Discs {
            places: Places {
                points: &at[37 * frame..][..37],
                normals: &facing[37 * frame..][..37],
            },
            areas: &areas,
        };
        let all = Discs {
            places: Places {
                points: &at,
                normals: &facing,
            },
            areas: &areas,
        };
        let found = form_factors(2, &places, &all).unwrap();
        for (i, sum) in found.iter().enumerate() {
            let expected = plainly(points[i], normals[i], &discs(i / 5));
            assert!((sum - expected).abs() < 1e-12, "{i}: {sum} {expected}");
        }
    }

    #[test]
    fn a_plane_overhead_covers_all_and_one_behind_nothing() {
        let side = 400;
        let step = 0.5 / f64::from(side);
        let grid = |height: f64| -> Vec<[f64; 3]> {
            let place = |i: i32| (f64::from(i) + 0.5) * step - 0.25;
            (0..side * side)
                .map(|i| [place(i / side), place(i % side), height])
                .collect()
        };
        let areas = vec![step * step; (side * side) as usize];
        let taken = |height: f64, facing: f64| {
            let (points, normals) = (grid(height), vec![[0.0, 0.0, facing]; areas.len()]);
            let discs = Discs {
                places: Places {
                    points: &points,
                    normals: &normals,
                },
                areas: &areas,
            };
            let places = Places {
                points: &[[0.0; 3]],
                normals: &[[0.0, 0.0, 1.0]],
            };
            form_factors(1, &places, &discs).unwrap()[0]
        };
        let all = taken(0.01, -1.0);
        assert!((all - 1.0).abs() < 0.02, "{all}");
        assert_eq!(taken(0.01, 1.0), 0.0);
        assert_eq!(taken(-0.01, 1.0), 0.0);
    }

    #[test]
    fn lengths_are_checked() {
        let (points, normals) = random(3, 4);
        let places = Places {
            points: &points,
            normals: &normals,
        };
        let discs = Discs {
            places,
            areas: &[1.0; 3],
        };
        assert!(form_factors(2, &places, &discs).is_err());
        let short = Places {
            points: &points,
            normals: &normals[..3],
        };
        assert!(
            form_factors(
                1,
                &short,
                &Discs {
                    places,
                    areas: &[1.0; 4]
                }
            )
            .is_err()
        );
    }
}

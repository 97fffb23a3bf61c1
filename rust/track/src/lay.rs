//! Patches moved over another picture to where they fit best.
//!
//! Gauss-Newton on the shift alone with the template's slopes: inverse compositional, after Baker and Matthews,
//! "Lucas-Kanade 20 years on" (2004). Both sides are brought to mean 0 and deviation 1, since light changes as an object
//! turns.

use rayon::prelude::*;

use crate::cut::offset;
use crate::sums::sum;
use crate::{Picture, Templates, TrackError};

/// Samples beside what is tracked in the other picture, by more than this share, count for nothing.
const LEAST_ON: f32 = 0.5;
/// No step is longer than this along an axis of the template, pixels.
const LONGEST_STEP: f32 = 1.5;
/// A patch that steps less than this is where it belongs.
const SHORTEST_STEP: f32 = 1e-4;
/// Least deviation of grey values that a patch is divided by.
const LEAST_DEVIATION: f32 = 1e-3;
/// An edge or an even patch leaves a direction open: there a place keeps where it began, by this share of the slopes.
const RIDGE: f32 = 1e-3;
const TINY: f32 = 1e-9;

/// How patches are laid, and which of them count; lengths in pixels of the picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Laying {
    /// Half a side of a patch, less its middle.
    pub half: usize,
    /// Steps of Gauss-Newton, at most.
    pub iterations: usize,
    /// Share of a patch's weight that must show, ...
    pub least_shown: f32,
    /// ... its least correlation with what it is laid on, ...
    pub likeness: f32,
    /// ... how far it may go, ...
    pub most_moved: f32,
    /// ... and the standard deviation of its place along the direction in which it says least.
    pub most_unsure: f32,
}

/// Where patches came to lie.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Laid {
    /// Their middles.
    pub places: Vec<[f32; 2]>,
    /// How sure these are: covariances (right right, right down, down down), where what is unlike is taken for noise.
    pub covariances: Vec<[f32; 3]>,
    /// Which were recognised, and say where they are.
    pub fits: Vec<bool>,
}

/// Lay patches on a picture, from `starts` on, each turned by its `warp`: row by row, what a step to the right and one
/// down in its own picture are in this one.
///
/// # Errors
///
/// Arrays that do not hold one patch for every start.
pub fn lay(
    picture: &Picture<'_>,
    templates: &Templates<'_>,
    starts: &[[f32; 2]],
    warps: &[[[f32; 2]; 2]],
    settings: &Laying,
) -> Result<Laid, TrackError> {
    let size = (2 * settings.half + 1).pow(2);
    let expected = starts.len() * size;
    for (what, expected, found) in [
        ("grey", expected, templates.grey.len()),
        ("slope", expected, templates.slope.len()),
        ("weight", expected, templates.weight.len()),
        ("warps", starts.len(), warps.len()),
    ] {
        if found != expected {
            return Err(TrackError::length(what, expected, found));
        }
    }
    let found: Vec<Landed> = (
        templates.grey.par_chunks_exact(size),
        templates.slope.par_chunks_exact(size),
        templates.weight.par_chunks_exact(size),
        starts,
        warps,
    )
        .into_par_iter()
        .map_init(
            || Patch::new(settings.half),
            |patch, (grey, slope, weight, &start, warp)| {
                patch.prepare(picture, grey, slope, weight, start, *warp);
                patch.settle(picture, start, settings)
            },
        )
        .collect();
    Ok(Laid {
        places: found.iter().map(|landed| landed.place).collect(),
        covariances: found.iter().map(|landed| landed.covariance).collect(),
        fits: found.iter().map(|landed| landed.fits).collect(),
    })
}

/// One patch on its way; the buffers serve one after the other.
struct Patch {
    half: usize,
    warp: [[f32; 2]; 2],
    /// Where the samples are, from the patch's middle, in the picture that it is laid on.
    spread: Vec<[f32; 2]>,
    /// How far the furthest of them is, right or left and up or down.
    reach: [f32; 2],
    /// Shares of the samples that show: they sum to 1.
    weight: Vec<f32>,
    /// The template at mean 0 and deviation 1, times the weights.
    wanted: Vec<f32>,
    /// Its slopes, likewise.
    slope: Vec<[f32; 2]>,
    /// Grey values as they are seen.
    seen: Vec<f32>,
    /// About which grey values are counted, so that their squares keep their digits.
    middle: f32,
    /// Sums over the samples: of the template, of its slopes by it, and of its slopes.
    sums: [f32; 5],
    shown: f32,
    normal: [f32; 3],
}

/// Where one patch came to lie.
struct Landed {
    place: [f32; 2],
    covariance: [f32; 3],
    fits: bool,
}

/// What a patch says at a place.
struct Look {
    likeness: f32,
    pull: [f32; 2],
}

impl Patch {
    fn new(half: usize) -> Self {
        let size = (2 * half + 1).pow(2);
        Self {
            half,
            warp: [[0.0; 2]; 2],
            spread: vec![[0.0; 2]; size],
            reach: [0.0; 2],
            weight: vec![0.0; size],
            wanted: vec![0.0; size],
            slope: vec![[0.0; 2]; size],
            seen: vec![0.0; size],
            middle: 0.0,
            sums: [0.0; 5],
            shown: 0.0,
            normal: [0.0; 3],
        }
    }

    fn is_upright(&self) -> bool {
        self.warp == [[1.0, 0.0], [0.0, 1.0]]
    }

    /// Take a template, with the weight of what shows of it at `start`.
    fn prepare(
        &mut self,
        picture: &Picture<'_>,
        grey: &[f32],
        slope: &[[f32; 2]],
        weight: &[f32],
        start: [f32; 2],
        warp: [[f32; 2]; 2],
    ) {
        self.warp = warp;
        for (sample, spread) in self.spread.iter_mut().enumerate() {
            let [x, y] = offset(sample, self.half);
            *spread = [warp[0][0] * x + warp[0][1] * y, warp[1][0] * x + warp[1][1] * y];
        }
        let half = self.half as f32;
        self.reach = warp.map(|row| half * (row[0].abs() + row[1].abs()));
        self.look(picture, picture.shown, start);
        let size = self.spread.len();
        for sample in 0..size {
            let [dx, dy] = self.spread[sample];
            let on = self.seen[sample] > LEAST_ON && picture.holds([start[0] + dx, start[1] + dy]);
            self.weight[sample] = if on { weight[sample] } else { 0.0 };
        }
        let [shown, full] = sum(size, |s| [self.weight[s], weight[s]]);
        self.shown = shown / full.max(TINY);
        let total = shown + size as f32 * TINY;
        for weight in &mut self.weight {
            *weight = (*weight + TINY) / total;
        }
        let [mean, across, down] = sum(size, |s| {
            let w = self.weight[s];
            [w * grey[s], w * slope[s][0], w * slope[s][1]]
        });
        let [variance] = sum(size, |s| [self.weight[s] * (grey[s] - mean).powi(2)]);
        let deviation = variance.sqrt().max(LEAST_DEVIATION);
        self.middle = mean;
        for s in 0..size {
            let w = self.weight[s];
            self.wanted[s] = w * (grey[s] - mean) / deviation;
            self.slope[s] = [
                w * (slope[s][0] - across) / deviation,
                w * (slope[s][1] - down) / deviation,
            ];
        }
        self.normal = sum(size, |s| {
            let [a, b] = self.slope[s];
            let w = self.weight[s];
            [a * a / w, a * b / w, b * b / w]
        });
        self.sums = sum(size, |s| {
            let [a, b] = self.slope[s];
            let wanted = self.wanted[s] / self.weight[s];
            [self.wanted[s], a * wanted, b * wanted, a, b]
        });
    }

    /// Step to where the patch fits best; says whether it does.
    fn settle(&mut self, picture: &Picture<'_>, start: [f32; 2], settings: &Laying) -> Landed {
        let [a, b, c] = self.normal;
        let ridge = RIDGE * (a + c) + TINY;
        let determinant = (a + ridge) * (c + ridge) - b * b;
        let mut place = start;
        for _ in 0..settings.iterations {
            let [p, q] = self.compare(picture, place).pull;
            let step = [
                ((c + ridge) * p - b * q) / determinant,
                ((a + ridge) * q - b * p) / determinant,
            ]
            .map(|step| step.clamp(-LONGEST_STEP, LONGEST_STEP));
            for axis in 0..2 {
                place[axis] -= self.warp[axis][0] * step[0] + self.warp[axis][1] * step[1];
            }
            if step[0].abs().max(step[1].abs()) < SHORTEST_STEP {
                break;
            }
        }
        let likeness = self.compare(picture, place).likeness;
        let [spread] = sum(self.weight.len(), |s| [self.weight[s].powi(2)]);
        // What is unlike is taken for noise.
        let noise = (2.0 * (1.0 - likeness)).max(1e-6) * spread;
        let least = 0.5 * (a + c) - (0.25 * (a - c).powi(2) + b * b).sqrt();
        let unsure = (noise / least.max(TINY)).sqrt();
        let moved = (place[0] - start[0]).hypot(place[1] - start[1]);
        let fits = likeness > settings.likeness
            && moved < settings.most_moved
            && self.shown > settings.least_shown
            && unsure < settings.most_unsure;
        Landed {
            place,
            covariance: self.covariance(noise),
            fits,
        }
    }

    /// How sure a place is, in the picture that the patch is laid on, for `noise` of the patch's own deviation.
    fn covariance(&self, noise: f32) -> [f32; 3] {
        let [a, b, c] = self.normal;
        let scale = noise / (a * c - b * b).max(TINY);
        let [[r, s], [t, u]] = self.warp;
        // warp [[c, -b], [-b, a]] warpᵀ
        [
            r * r * c - 2.0 * r * s * b + s * s * a,
            r * t * c - (r * u + s * t) * b + s * u * a,
            t * t * c - 2.0 * t * u * b + u * u * a,
        ]
        .map(|value| scale * value)
    }

    /// How like the template the picture is at a place, and where it pulls.
    fn compare(&mut self, picture: &Picture<'_>, place: [f32; 2]) -> Look {
        self.look(picture, picture.grey, place);
        let size = self.seen.len();
        let middle = self.middle;
        let [mean, dot, p, q] = sum(size, |s| {
            let value = self.seen[s] - middle;
            let [a, b] = self.slope[s];
            [
                self.weight[s] * value,
                self.wanted[s] * value,
                a * value,
                b * value,
            ]
        });
        let [variance] = sum(size, |s| {
            let value = self.seen[s] - middle - mean;
            [self.weight[s] * value * value]
        });
        let [wanted, wanted_p, wanted_q, sum_p, sum_q] = self.sums;
        let deviation = variance.sqrt().max(LEAST_DEVIATION);
        Look {
            likeness: (dot - mean * wanted) / deviation,
            pull: [
                (p - mean * sum_p) / deviation - wanted_p,
                (q - mean * sum_q) / deviation - wanted_q,
            ],
        }
    }

    /// A plane's values at the samples.
    fn look(&mut self, picture: &Picture<'_>, plane: &[f32], place: [f32; 2]) {
        if self.is_upright() {
            picture.square(plane, place, self.half, &mut self.seen);
            return;
        }
        picture.scattered(plane, place, &self.spread, self.reach, &mut self.seen);
    }
}

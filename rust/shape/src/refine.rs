//! Symmetries moved to where they suit what was seen best.

use rayon::prelude::*;

use crate::symmetry::{across, dot, times};
use crate::{Judge, Kind, Symmetry};

/// How far carried samples look for what they meet, in reaches: first and last.
const REACHES: [f64; 2] = [4.0, 1.5];
/// Rounds, each with a choice of what meets what.
const ROUNDS: usize = 6;
/// Steps of Gauss-Newton in a round, at most.
const STEPS: usize = 3;
/// Fewer samples that meet say nothing.
const LEAST: usize = 30;
/// Distances beyond this share of the reach count little more than in proportion.
const SCALE: f64 = 0.5;

/// Keeps a direction in which nothing changes still, as a share of the others.
const RIDGE: f64 = 1e-9;

/// A sample, the turn that carries it, and the sample that it meets.
#[derive(Clone, Copy)]
struct Meeting {
    own: usize,
    turn: usize,
    met: usize,
}

/// Half the sum of squares, the matrix and the right side of a step of Gauss-Newton.
#[derive(Clone, Copy, Default)]
struct Normal {
    cost: f64,
    matrix: [[f64; 4]; 4],
    slope: [f64; 4],
}

impl Judge {
    /// Each symmetry moved to where the carried samples lie on the planes of those they meet; `size` is the object's.
    #[must_use]
    pub fn refined(&self, symmetries: &[Symmetry], size: f64) -> Vec<Symmetry> {
        symmetries
            .par_iter()
            .map(|&symmetry| self.settled(symmetry, size))
            .collect()
    }

    fn settled(&self, mut symmetry: Symmetry, size: f64) -> Symmetry {
        let [first, last] = REACHES;
        for round in 0..ROUNDS {
            let share = first * (last / first).powf(round as f64 / (ROUNDS - 1) as f64);
            let meetings = self.meetings(&symmetry, share * self.reach);
            if meetings.len() < LEAST {
                break;
            }
            let mut normal = self.normal(&symmetry, &meetings, size);
            for _ in 0..STEPS {
                let moved = symmetry.moved(step(&normal), size);
                let next = self.normal(&moved, &meetings, size);
                if !(next.cost < normal.cost) {
                    break;
                }
                (symmetry, normal) = (moved, next);
            }
        }
        symmetry
    }

    /// What each carried sample meets within reach.
    fn meetings(&self, symmetry: &Symmetry, reach: f64) -> Vec<Meeting> {
        let matrices = symmetry.matrices(self.turns);
        let mut meetings = Vec::new();
        for (turn, matrix) in matrices.iter().enumerate() {
            for own in self.carries(symmetry.kind) {
                let place = symmetry.carried(matrix, self.samples.points[own]);
                let normal = times(matrix, self.samples.normals[own]);
                if let Some(met) = self.meets(place, normal, reach) {
                    meetings.push(Meeting { own, turn, met });
                }
            }
        }
        meetings
    }

    /// How far carried samples are off the planes of those they meet, and what `Symmetry::moved` changes about it.
    fn normal(&self, symmetry: &Symmetry, meetings: &[Meeting], size: f64) -> Normal {
        let matrices = symmetry.matrices(self.turns);
        let scale = SCALE * self.reach;
        let d = symmetry.direction;
        let [first, second] = across(d);
        let mut sums = Normal::default();
        for meeting in meetings {
            let matrix = &matrices[meeting.turn];
            let own = self.samples.points[meeting.own];
            let normal = self.samples.normals[meeting.met];
            let there = self.samples.points[meeting.met];
            let arm = [0, 1, 2].map(|i| own[i] - symmetry.point[i]);
            let carried = symmetry.carried(matrix, own);
            let off = dot([0, 1, 2].map(|i| carried[i] - there[i]), normal);
            let [by_point, by_direction] = symmetry.slopes(meeting.turn, self.turns, arm, normal);
            let slope = match symmetry.kind {
                Kind::Plane => [0.0, size * dot(by_point, d)],
                Kind::Axis => [size * dot(by_point, first), size * dot(by_point, second)],
            };
            let slope = [
                slope[0],
                slope[1],
                dot(by_direction, first),
                dot(by_direction, second),
            ];
            // A distance counts by its square when small, and in proportion when large.
            let root = (1.0 + (off / scale).powi(2)).sqrt();
            sums.cost += scale * scale * (root - 1.0);
            for i in 0..4 {
                sums.slope[i] += slope[i] * off / root;
                for j in 0..4 {
                    sums.matrix[i][j] += slope[i] * slope[j] / root;
                }
            }
        }
        sums
    }
}

/// The step that solves the normal equations, by Gauss's elimination; their matrix is positive.
fn step(normal: &Normal) -> [f64; 4] {
    let (mut a, mut x) = (normal.matrix, normal.slope.map(|slope| -slope));
    let most = (0..4).fold(0.0, |most: f64, i| most.max(a[i][i]));
    for i in 0..4 {
        a[i][i] += RIDGE * most + f64::MIN_POSITIVE;
    }
    for i in 0..4 {
        for j in i + 1..4 {
            let share = a[j][i] / a[i][i];
            for k in i..4 {
                a[j][k] -= share * a[i][k];
            }
            x[j] -= share * x[i];
        }
    }
    for i in (0..4).rev() {
        let known: f64 = (i + 1..4).map(|k| a[i][k] * x[k]).sum();
        x[i] = (x[i] - known) / a[i][i];
    }
    x
}

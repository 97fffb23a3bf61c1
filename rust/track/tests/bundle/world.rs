//! A simulated scene, and dense equations of it by plain loops, with derivatives that are differences.

use bigs_track::{Scene, Sightings};

pub(crate) const SIGMA: f64 = 0.5;
pub(crate) const FOCAL: [f64; 2] = [900.0, 880.0];
pub(crate) const MIDDLE: [f64; 2] = [240.0, 180.0];

/// A scene and what was seen of it.
#[derive(Clone)]
pub(crate) struct World {
    pub(crate) rotations: Vec<[f64; 9]>,
    pub(crate) transl: Vec<[f64; 3]>,
    pub(crate) points: Vec<[f64; 3]>,
    pub(crate) frame: Vec<i64>,
    pub(crate) point: Vec<i64>,
    pub(crate) pixels: Vec<[f64; 2]>,
    pub(crate) precision: Vec<[f64; 3]>,
    pub(crate) free: Vec<bool>,
}

/// The rotation about a vector by its length, by Rodrigues' formula.
pub(crate) fn rotation([x, y, z]: [f64; 3]) -> [f64; 9] {
    let angle = (x * x + y * y + z * z).sqrt().max(1e-12);
    let (s, c) = (
        angle.sin() / angle,
        2.0 * (0.5 * angle).sin().powi(2) / angle.powi(2),
    );
    [
        1.0 - c * (y * y + z * z),
        c * x * y - s * z,
        c * x * z + s * y,
        c * x * y + s * z,
        1.0 - c * (x * x + z * z),
        c * y * z - s * x,
        c * x * z - s * y,
        c * y * z + s * x,
        1.0 - c * (x * x + y * y),
    ]
}

pub(crate) fn turned(turn: &[f64; 9], [x, y, z]: [f64; 3]) -> [f64; 3] {
    [0, 3, 6].map(|row| turn[row] * x + turn[row + 1] * y + turn[row + 2] * z)
}

impl World {
    /// Points of which every frame sees a share, some of them twice; the first and the fourth frame may not move.
    pub(crate) fn random(frames: usize, points: usize, share: f64) -> Self {
        let mut rng = fastrand::Rng::with_seed(7);
        let mut next = move || rng.f64() - 0.5;
        let mut world = Self {
            rotations: (0..frames)
                .map(|t| rotation([0.1, 1.0, 0.3].map(|axis| axis * t as f64 / frames as f64)))
                .collect(),
            transl: (0..frames)
                .map(|_| [0.01 * next(), 0.01 * next(), 0.7 + 0.02 * next()])
                .collect(),
            points: (0..points)
                .map(|_| [0.1 * next(), 0.1 * next(), 0.1 * next()])
                .collect(),
            frame: vec![],
            point: vec![],
            pixels: vec![],
            precision: vec![],
            free: (0..frames).map(|t| t != 0 && t != 3).collect(),
        };
        for point in 0..points {
            for frame in 0..frames {
                let times = if frame > 1 && next() + 0.5 > share {
                    0
                } else {
                    1 + usize::from(next() > 0.45)
                };
                for _ in 0..times {
                    let at = world.project(frame, point, &[0.0; 10]);
                    let (a, b, c) = (1.0 + 0.8 * next(), 0.8 * next(), 1.0 + 0.8 * next());
                    world.frame.push(frame as i64);
                    world.point.push(point as i64);
                    world.pixels.push([at[0] + 2.0 * next(), at[1] + 2.0 * next()]);
                    world.precision.push([a * a, a * b, b * b + c * c]);
                }
            }
        }
        world
    }

    /// Where a frame sees a point after a change of its pose, of the point and of the logarithm of the focal length.
    pub(crate) fn project(&self, frame: usize, point: usize, change: &[f64; 10]) -> [f64; 2] {
        let &[tx, ty, tz, sx, sy, sz, x, y, z, growth] = change;
        let [px, py, pz] = self.points[point];
        let arm = turned(&self.rotations[frame], [px + x, py + y, pz + z]);
        let arm = turned(&rotation([tx, ty, tz]), arm);
        let shift = self.transl[frame];
        let place = [
            arm[0] + shift[0] + sx,
            arm[1] + shift[1] + sy,
            arm[2] + shift[2] + sz,
        ];
        [0, 1].map(|i| growth.exp() * FOCAL[i] * place[i] / place[2] + MIDDLE[i])
    }

    pub(crate) fn scene(&self) -> Scene<'_> {
        Scene {
            rotations: &self.rotations,
            transl: &self.transl,
            points: &self.points,
            focal: FOCAL,
            middle: MIDDLE,
            sigma: SIGMA,
        }
    }

    pub(crate) fn sightings(&self) -> Sightings {
        let (pixels, precision) = (self.pixels.clone(), self.precision.clone());
        Sightings::new(&self.frame, &self.point, pixels, precision, &self.free).unwrap()
    }

    /// Rows of an observation's derivatives (pose, point, growth), its weights (xx, xy, yy), and its error.
    pub(crate) fn observed(&self, row: usize) -> ([[f64; 10]; 2], [f64; 3], [f64; 2]) {
        let (frame, point) = (self.frame[row] as usize, self.point[row] as usize);
        let mut rows = [[0.0; 10]; 2];
        for k in 0..10 {
            let mut step = [0.0; 10];
            step[k] = 1e-6;
            let ahead = self.project(frame, point, &step);
            let behind = self.project(frame, point, &step.map(|value| -value));
            for i in 0..2 {
                rows[i][k] = (ahead[i] - behind[i]) / 2e-6;
            }
        }
        let at = self.project(frame, point, &[0.0; 10]);
        let off = [0, 1].map(|i| at[i] - self.pixels[row][i]);
        let [xx, xy, yy] = self.precision[row];
        let squared = xx * off[0] * off[0] + 2.0 * xy * off[0] * off[1] + yy * off[1] * off[1];
        (
            rows,
            [xx, xy, yy].map(|value| value / (SIGMA * SIGMA + squared)),
            off,
        )
    }
}

/// Dense equations: poses, then for each point three columns; the focal length last.
pub(crate) struct Dense {
    pub(crate) matrix: Vec<Vec<f64>>,
    pub(crate) gradient: Vec<f64>,
}

/// The columns of an observation's pose, if that may move, and of its point and the focal length.
pub(crate) fn columns(world: &World, row: usize) -> Vec<(usize, usize)> {
    let frame = world.frame[row] as usize;
    let moving = world.free.iter().filter(|free| **free).count();
    let slot = world.free[..frame].iter().filter(|free| **free).count();
    let mut columns = vec![];
    if world.free[frame] {
        columns.extend((0..6).map(|i| (i, 6 * slot + i)));
    }
    let first = 6 * moving + 3 * world.point[row] as usize;
    columns.extend((0..3).map(|i| (6 + i, first + i)));
    columns.push((9, 6 * moving + 3 * world.points.len()));
    columns
}

pub(crate) fn dense(world: &World) -> Dense {
    let moving = world.free.iter().filter(|free| **free).count();
    let count = 6 * moving + 3 * world.points.len() + 1;
    let mut dense = Dense {
        matrix: vec![vec![0.0; count]; count],
        gradient: vec![0.0; count],
    };
    for row in 0..world.frame.len() {
        let (rows, [xx, xy, yy], off) = world.observed(row);
        let columns = columns(world, row);
        for &(own, i) in &columns {
            let (a, b) = (rows[0][own], rows[1][own]);
            let weighted = [xx * a + xy * b, xy * a + yy * b];
            dense.gradient[i] += weighted[0] * off[0] + weighted[1] * off[1];
            for &(other, j) in &columns {
                dense.matrix[i][j] += weighted[0] * rows[0][other] + weighted[1] * rows[1][other];
            }
        }
    }
    dense
}

/// The first `kept` unknowns' equations after the others up to `end` are eliminated one by one.
pub(crate) fn eliminated(mut dense: Dense, kept: usize, end: usize) -> Dense {
    for k in (kept..end).rev() {
        let (pivot, pull) = (dense.matrix[k].clone(), dense.gradient[k]);
        for i in 0..k {
            let share = dense.matrix[i][k] / pivot[k];
            if share != 0.0 {
                dense.gradient[i] -= share * pull;
                for j in 0..k {
                    dense.matrix[i][j] -= share * pivot[j];
                }
            }
        }
    }
    dense
}

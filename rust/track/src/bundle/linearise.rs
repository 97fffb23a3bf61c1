//! Gauss-Newton's normal equations of reprojection errors.

use rayon::prelude::*;

use crate::TrackError;
use crate::bundle::glance::Glance;
use crate::bundle::sightings::STILL;
use crate::bundle::{Scene, Sightings};

/// Numbers of a pose's symmetric block, row by row up to the diagonal.
const BLOCK: usize = 21;

/// How an observation couples its point with its pose: the arm from the object's origin to the point, and for each axis
/// of the camera the second derivatives of the loss by the place and by the point. A shift of the pose is coupled by the
/// latter, a turn by the arm crossed with them.
pub(crate) type Coupling = [f64; 12];

/// Normal equations of F poses and P points under Cauchy's loss.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct System {
    /// 6F × 6F, blocks on the diagonal.
    pub poses: Vec<f64>,
    /// 6F.
    pub pose_gradient: Vec<f64>,
    /// P, row by row.
    pub points: Vec<[f64; 9]>,
    /// P.
    pub point_gradient: Vec<[f64; 3]>,
    /// One for each observation.
    pub couplings: Vec<Coupling>,
}

/// Sums over the observations of one frame.
#[derive(Clone, Copy)]
struct Pose {
    block: [f64; BLOCK],
    gradient: [f64; 6],
}

const NOTHING: Pose = Pose {
    block: [0.0; BLOCK],
    gradient: [0.0; 6],
};

impl Sightings {
    /// The normal equations at a scene.
    ///
    /// # Errors
    ///
    /// A scene of another number of frames or points.
    pub fn linearise(&self, scene: &Scene<'_>) -> Result<System, TrackError> {
        scene.check(self)?;
        let mut points = vec![[0.0; 9]; self.points()];
        let mut point_gradient = vec![[0.0; 3]; self.points()];
        let mut couplings = vec![[0.0; 12]; self.count()];
        let sums: Vec<Vec<Pose>> = (
            self.pieces.par_iter(),
            self.by_piece(&mut points),
            self.by_piece(&mut point_gradient),
            self.rows_by_piece(&mut couplings),
        )
            .into_par_iter()
            .map(|(piece, points, gradients, couplings)| {
                let mut poses = vec![NOTHING; self.moving];
                let mut couplings = couplings.iter_mut();
                for ((point, matrix), gradient) in piece.clone().zip(points).zip(gradients) {
                    let rows = self.starts[point]..self.starts[point + 1];
                    for (row, coupling) in rows.zip(&mut couplings) {
                        let frame = self.frame[row] as usize;
                        let glance =
                            Glance::new(scene, (frame, point), self.pixels[row], self.precision[row]);
                        *coupling = glance.add_point(&scene.rotations[frame], matrix, gradient);
                        let slot = self.slots[frame];
                        if slot != STILL {
                            glance.add_pose(&mut poses[slot as usize]);
                        }
                    }
                    for (i, j) in [(0, 1), (0, 2), (1, 2)] {
                        matrix[3 * i + j] = matrix[3 * j + i];
                    }
                }
                poses
            })
            .collect();
        let unknowns = 6 * self.moving;
        let mut system = System {
            poses: vec![0.0; unknowns * unknowns],
            pose_gradient: vec![0.0; unknowns],
            points,
            point_gradient,
            couplings,
        };
        for slot in 0..self.moving {
            let mut total = NOTHING;
            for part in &sums {
                add(&mut total.block, &part[slot].block);
                add(&mut total.gradient, &part[slot].gradient);
            }
            system.pose_gradient[6 * slot..][..6].copy_from_slice(&total.gradient);
            let mut block = total.block.iter();
            for i in 0..6 {
                for (j, value) in (0..=i).zip(&mut block) {
                    system.poses[(6 * slot + i) * unknowns + 6 * slot + j] = *value;
                    system.poses[(6 * slot + j) * unknowns + 6 * slot + i] = *value;
                }
            }
        }
        Ok(system)
    }
}

impl Glance {
    /// Add to the point's equations, whose matrix gets its lower half.
    #[inline(always)]
    fn add_point(&self, turn: &[f64; 9], matrix: &mut [f64; 9], gradient: &mut [f64; 3]) -> Coupling {
        let rows = self.by_point(turn);
        let weighted = self.weighted(&rows);
        for i in 0..3 {
            gradient[i] += rows[0][i] * self.pull[0] + rows[1][i] * self.pull[1];
            for j in 0..=i {
                matrix[3 * i + j] += rows[0][i] * weighted[0][j] + rows[1][i] * weighted[1][j];
            }
        }
        let [[wide, _, far_x], [_, high, far_y]] = self.slope;
        let mut coupling = [0.0; 12];
        coupling[..3].copy_from_slice(&self.arm);
        for j in 0..3 {
            coupling[3 + j] = wide * weighted[0][j];
            coupling[6 + j] = high * weighted[1][j];
            coupling[9 + j] = far_x * weighted[0][j] + far_y * weighted[1][j];
        }
        coupling
    }

    #[inline(always)]
    fn add_pose(&self, pose: &mut Pose) {
        let rows = self.by_pose();
        let weighted = self.weighted(&rows);
        let mut at = 0;
        for i in 0..6 {
            pose.gradient[i] += rows[0][i] * self.pull[0] + rows[1][i] * self.pull[1];
            for j in 0..=i {
                pose.block[at] += rows[0][i] * weighted[0][j] + rows[1][i] * weighted[1][j];
                at += 1;
            }
        }
    }
}

fn add(sum: &mut [f64], part: &[f64]) {
    for (sum, part) in sum.iter_mut().zip(part) {
        *sum += part;
    }
}

//! The focal length among the unknowns.

use rayon::prelude::*;

use crate::TrackError;
use crate::bundle::glance::Glance;
use crate::bundle::sightings::STILL;
use crate::bundle::{Scene, Sightings};

/// The part of the normal equations that the logarithm of a factor on the focal length has.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Border {
    /// 6F: its coupling with the poses.
    pub poses: Vec<f64>,
    /// P: with the points.
    pub points: Vec<[f64; 3]>,
    /// Second derivative of the loss, halved.
    pub stiffness: f64,
    /// First derivative, halved.
    pub gradient: f64,
}

impl Sightings {
    /// The focal length's part of the normal equations at a scene.
    ///
    /// # Errors
    ///
    /// A scene of another number of frames or points.
    pub fn border(&self, scene: &Scene<'_>) -> Result<Border, TrackError> {
        scene.check(self)?;
        let mut points = vec![[0.0; 3]; self.points()];
        let parts: Vec<(Vec<[f64; 6]>, [f64; 2])> = (self.pieces.par_iter(), self.by_piece(&mut points))
            .into_par_iter()
            .map(|(piece, points)| {
                let mut poses = vec![[0.0; 6]; self.moving];
                let mut own = [0.0; 2];
                for (point, by_point) in piece.clone().zip(points) {
                    for row in self.starts[point]..self.starts[point + 1] {
                        let frame = self.frame[row] as usize;
                        let (pixel, precision) = (self.pixels[row], self.precision[row]);
                        let glance = Glance::new(scene, (frame, point), pixel, precision);
                        // How the pixel grows with the focal length.
                        let grown = [0, 1].map(|i| scene.focal[i] * glance.ray[i]);
                        let held = glance.weighted(&grown.map(|value| [value])).map(|[value]| value);
                        own[0] += grown[0] * held[0] + grown[1] * held[1];
                        own[1] += grown[0] * glance.pull[0] + grown[1] * glance.pull[1];
                        let add = |sum: &mut [f64], [right, down]: [&[f64]; 2]| {
                            for ((sum, right), down) in sum.iter_mut().zip(right).zip(down) {
                                *sum += right * held[0] + down * held[1];
                            }
                        };
                        let [right, down] = glance.by_point(&scene.rotations[frame]);
                        add(by_point, [&right, &down]);
                        let slot = self.slots[frame];
                        if slot != STILL {
                            let [right, down] = glance.by_pose();
                            add(&mut poses[slot as usize], [&right, &down]);
                        }
                    }
                }
                (poses, own)
            })
            .collect();
        let mut border = Border {
            poses: vec![0.0; 6 * self.moving],
            points,
            ..Border::default()
        };
        for (poses, [stiffness, gradient]) in &parts {
            for (sum, part) in border.poses.iter_mut().zip(poses.as_flattened()) {
                *sum += part;
            }
            border.stiffness += stiffness;
            border.gradient += gradient;
        }
        Ok(border)
    }
}

//! Poses from what was learned.

use bigs_raster::Real;
use rayon::prelude::*;

use super::HandPoses;
use crate::OpsError;
use crate::mat3::{Mat3, Vec3, apply, flat, matrix, plus, product, rotation, scaled};

/// Poses of the B frames.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedHand<T> {
    /// B.
    pub orient: Vec<[T; 9]>,
    /// B × J.
    pub fingers: Vec<[T; 9]>,
    /// B wrists in camera space.
    pub wrist: Vec<[T; 3]>,
}

/// What a frame's residuals start from.
pub(super) struct FrameStart<T> {
    /// Its grasp, if it has one.
    pub(super) grasp: Option<usize>,
    /// What its residuals are multiplied by.
    pub(super) freedom: T,
    pub(super) orient: Mat3<T>,
    pub(super) fingers: Vec<Mat3<T>>,
    pub(super) ray: [T; 2],
    log_depth: T,
    /// The wrist where a grasp has it.
    pub(super) wrist: Vec3<T>,
}

impl<T: Real> HandPoses<'_, T> {
    /// What the residuals of the frame at a place of `frames` start from.
    pub(super) fn frame_start(&self, at: usize) -> FrameStart<T> {
        let (frame, joints) = (self.frames[at], self.joints());
        let grasp = self
            .held
            .and_then(|held| Some((held, usize::try_from(held.of_frame[frame]).ok()?)));
        let Some((held, g)) = grasp else {
            let fingers = &self.start.fingers[frame * joints..][..joints];
            return FrameStart {
                grasp: None,
                freedom: T::ONE,
                orient: matrix(&self.start.orient[frame]),
                fingers: fingers.iter().map(matrix).collect(),
                ray: self.start.ray[frame],
                log_depth: self.start.log_depth[frame],
                wrist: [T::ZERO; 3],
            };
        };
        let turn = matrix(&held.rotations[at]);
        let own = product(&rotation(held.orient[g]), &matrix(&held.base_orient[g]));
        let fingers = held.base_fingers[g * joints..][..joints].iter();
        let learned = &held.fingers[g * joints..][..joints];
        let wrist = plus(scaled(held.scale, apply(&turn, held.place(g))), held.centers[at]);
        FrameStart {
            grasp: Some(g),
            freedom: held.slack,
            orient: product(&held.seen(&turn), &own),
            fingers: fingers
                .zip(learned)
                .map(|(base, &learned)| product(&matrix(base), &rotation(learned)))
                .collect(),
            ray: [wrist[0] / wrist[2], wrist[1] / wrist[2]],
            log_depth: T::of(wrist[2].as_f64().ln()),
            wrist,
        }
    }

    /// The turns that a frame's residuals are: of the whole hand, and of its fingers.
    pub(super) fn turns(&self, frame: usize, freedom: T) -> (Vec3<T>, impl Iterator<Item = Vec3<T>>) {
        let joints = self.joints();
        let fingers = self.residuals.fingers[frame * joints..][..joints].iter();
        (
            scaled(freedom, self.residuals.orient[frame]),
            fingers
                .zip(self.residuals.bias)
                .map(move |(&own, &bias)| scaled(freedom, plus(own, bias))),
        )
    }

    /// The point on the plane z = 1 and the depth.
    pub(super) fn place(&self, frame: usize, start: &FrameStart<T>) -> ([T; 2], T) {
        let own = self.residuals.ray[frame];
        let log_depth = start.log_depth + start.freedom * self.residuals.log_depth[frame];
        (
            [0, 1].map(|i| start.ray[i] + start.freedom * own[i]),
            T::of(log_depth.as_f64().exp()),
        )
    }

    /// The poses.
    ///
    /// # Errors
    /// A length that does not fit, or a frame or a grasp that there is not.
    pub fn pose(&self) -> Result<PosedHand<T>, OpsError> {
        self.check()?;
        let each = (0..self.frames.len())
            .into_par_iter()
            .map(|at| {
                let (frame, start) = (self.frames[at], self.frame_start(at));
                let (whole, fingers) = self.turns(frame, start.freedom);
                let bent = fingers
                    .zip(&start.fingers)
                    .map(|(turn, start)| flat(&product(start, &rotation(turn))));
                let bent: Vec<_> = bent.collect();
                let (ray, depth) = self.place(frame, &start);
                (
                    flat(&product(&rotation(whole), &start.orient)),
                    bent,
                    [ray[0] * depth, ray[1] * depth, depth],
                )
            })
            .collect::<Vec<_>>();
        let mut out = PosedHand {
            orient: Vec::with_capacity(self.frames.len()),
            fingers: Vec::with_capacity(self.frames.len() * self.joints()),
            wrist: Vec::with_capacity(self.frames.len()),
        };
        for (orient, fingers, wrist) in each {
            out.orient.push(orient);
            out.fingers.extend(fingers);
            out.wrist.push(wrist);
        }
        Ok(out)
    }
}

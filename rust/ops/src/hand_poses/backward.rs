//! Gradients of what was learned from those of the poses.

use bigs_raster::Real;
use rayon::prelude::*;

use super::{HandPoses, Held};
use crate::OpsError;
use crate::checks::check_length;
use crate::mat3::{
    Mat3, Vec3, add, add_outer, apply, dot, flat, matrix, product, rotation, rotation_vjp, scaled, transposed,
};

/// Gradients of the poses, `None` for zeros; shaped as [`PosedHand`](super::PosedHand).
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs)]
pub struct PosePulls<'a, T> {
    pub orient: Option<&'a [[T; 9]]>,
    pub fingers: Option<&'a [[T; 9]]>,
    pub wrist: Option<&'a [[T; 3]]>,
}

/// Gradients of what was learned.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct HandGradients<T> {
    pub orient: Vec<[T; 3]>,
    pub fingers: Vec<[T; 3]>,
    pub bias: Vec<[T; 3]>,
    pub ray: Vec<[T; 2]>,
    pub log_depth: Vec<T>,
    pub held: Option<HeldGradients<T>>,
}

/// Gradients of grasps and of the object that carries them.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct HeldGradients<T> {
    pub orient: Vec<[T; 3]>,
    pub fingers: Vec<[T; 3]>,
    pub position: Vec<[T; 3]>,
    pub rotations: Vec<[T; 9]>,
    pub centers: Vec<[T; 3]>,
    pub scale: T,
}

/// A frame's share of the gradients.
struct FrameGradients<T> {
    orient: Vec3<T>,
    fingers: Vec<Vec3<T>>,
    ray: [T; 2],
    log_depth: T,
    grasp: Option<GraspGradients<T>>,
}

struct GraspGradients<T> {
    grasp: usize,
    orient: Vec3<T>,
    fingers: Vec<Vec3<T>>,
    position: Vec3<T>,
    rotation: Mat3<T>,
    center: Vec3<T>,
    scale: T,
}

impl<T: Real> HandPoses<'_, T> {
    /// Gradients of what was learned from those of the poses.
    ///
    /// # Errors
    /// As [`HandPoses::pose`], or gradients of another length.
    pub fn vjp(&self, v: PosePulls<'_, T>) -> Result<HandGradients<T>, OpsError> {
        self.check()?;
        let (count, joints) = (self.frames.len(), self.joints());
        check_length("v_orient", count, v.orient.map_or(count, <[_]>::len))?;
        check_length(
            "v_pose",
            count * joints,
            v.fingers.map_or(count * joints, <[_]>::len),
        )?;
        check_length("v_wrist", count, v.wrist.map_or(count, <[_]>::len))?;
        let each: Vec<FrameGradients<T>> = (0..count)
            .into_par_iter()
            .map(|at| self.frame_vjp(at, v))
            .collect();
        let clip = self.start.orient.len();
        let mut out = HandGradients {
            orient: vec![[T::ZERO; 3]; clip],
            fingers: vec![[T::ZERO; 3]; clip * joints],
            bias: vec![[T::ZERO; 3]; joints],
            ray: vec![[T::ZERO; 2]; clip],
            log_depth: vec![T::ZERO; clip],
            held: self.held.map(|held| HeldGradients {
                orient: vec![[T::ZERO; 3]; held.orient.len()],
                fingers: vec![[T::ZERO; 3]; held.fingers.len()],
                position: vec![[T::ZERO; 3]; held.position.len()],
                rotations: vec![[T::ZERO; 9]; count],
                centers: vec![[T::ZERO; 3]; count],
                scale: T::ZERO,
            }),
        };
        for (at, (&frame, own)) in self.frames.iter().zip(each).enumerate() {
            add(&mut out.orient[frame], own.orient);
            for (joint, &v) in own.fingers.iter().enumerate() {
                add(&mut out.fingers[frame * joints + joint], v);
                add(&mut out.bias[joint], v);
            }
            for i in 0..2 {
                out.ray[frame][i] += own.ray[i];
            }
            out.log_depth[frame] += own.log_depth;
            if let (Some(held), Some(own)) = (&mut out.held, own.grasp) {
                add(&mut held.orient[own.grasp], own.orient);
                for (joint, &v) in own.fingers.iter().enumerate() {
                    add(&mut held.fingers[own.grasp * joints + joint], v);
                }
                add(&mut held.position[own.grasp], own.position);
                held.rotations[at] = flat(&own.rotation);
                held.centers[at] = own.center;
                held.scale += own.scale;
            }
        }
        Ok(out)
    }

    fn frame_vjp(&self, at: usize, v: PosePulls<'_, T>) -> FrameGradients<T> {
        let (frame, joints) = (self.frames[at], self.joints());
        let start = self.frame_start(at);
        let (whole, fingers) = self.turns(frame, start.freedom);
        let nothing = [T::ZERO; 9];

        let v_orient = matrix(v.orient.map_or(&nothing, |v| &v[at]));
        let pull = product(&v_orient, &transposed(&start.orient));
        let orient = scaled(start.freedom, rotation_vjp(whole, &pull));
        let v_start_orient = product(&transposed(&rotation(whole)), &v_orient);

        let mut v_start_fingers = Vec::with_capacity(joints);
        let mut bends = Vec::with_capacity(joints);
        for (joint, turn) in fingers.enumerate() {
            let v = matrix(v.fingers.map_or(&nothing, |v| &v[at * joints + joint]));
            let pull = product(&transposed(&start.fingers[joint]), &v);
            bends.push(scaled(start.freedom, rotation_vjp(turn, &pull)));
            v_start_fingers.push(product(&v, &transposed(&rotation(turn))));
        }

        let (ray, depth) = self.place(frame, &start);
        let v_wrist = v.wrist.map_or([T::ZERO; 3], |v| v[at]);
        let v_ray = [depth * v_wrist[0], depth * v_wrist[1]];
        let v_log_depth = depth * (ray[0] * v_wrist[0] + ray[1] * v_wrist[1] + v_wrist[2]);

        let grasp = self.held.zip(start.grasp).map(|(held, g)| {
            let z = start.wrist[2];
            let across = start.ray[0] * v_ray[0] + start.ray[1] * v_ray[1];
            let v_place = [v_ray[0] / z, v_ray[1] / z, (v_log_depth - across) / z];
            self.grasp_vjp(&held, at, g, v_start_orient, &v_start_fingers, v_place)
        });
        FrameGradients {
            orient,
            fingers: bends,
            ray: v_ray.map(|v| start.freedom * v),
            log_depth: start.freedom * v_log_depth,
            grasp,
        }
    }

    /// Of a grasp from the gradients of the poses that it gives a frame.
    fn grasp_vjp(
        &self,
        held: &Held<'_, T>,
        at: usize,
        g: usize,
        v_orient: Mat3<T>,
        v_fingers: &[Mat3<T>],
        v_wrist: Vec3<T>,
    ) -> GraspGradients<T> {
        let joints = self.joints();
        let turn = matrix(&held.rotations[at]);
        let base = matrix(&held.base_orient[g]);
        let own = product(&rotation(held.orient[g]), &base);
        let mut rotated = held.seen(&product(&v_orient, &transposed(&own)));
        let v_own = product(&transposed(&held.seen(&turn)), &v_orient);
        let fingers = v_fingers.iter().enumerate().map(|(joint, v)| {
            let base = transposed(&matrix(&held.base_fingers[g * joints + joint]));
            rotation_vjp(held.fingers[g * joints + joint], &product(&base, v))
        });
        let place = held.place(g);
        add_outer(&mut rotated, held.scale, v_wrist, place);
        GraspGradients {
            grasp: g,
            orient: rotation_vjp(held.orient[g], &product(&v_own, &transposed(&base))),
            fingers: fingers.collect(),
            position: scaled(held.scale, apply(&transposed(&turn), v_wrist)),
            rotation: rotated,
            center: v_wrist,
            scale: dot(v_wrist, apply(&turn, place)),
        }
    }
}

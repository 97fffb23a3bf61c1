//! A hand's poses over a clip from where they start and what was learned: residuals of every frame, and grasps, in which
//! the object carries the hand.

mod backward;
mod forward;

use bigs_raster::Real;

use crate::OpsError;
use crate::checks::check_length;
use crate::mat3::{Mat3, Vec3, plus};

pub use backward::{HandGradients, HeldGradients, PosePulls};
pub use forward::PosedHand;

/// Poses of all T frames of a clip that residuals start from; rotations row by row.
#[derive(Clone, Copy, Debug)]
pub struct Start<'a, T> {
    /// T: of the hand as a whole.
    pub orient: &'a [[T; 9]],
    /// T × J.
    pub fingers: &'a [[T; 9]],
    /// T: the wrist on the plane z = 1.
    pub ray: &'a [[T; 2]],
    /// T: the logarithm of its depth.
    pub log_depth: &'a [T],
}

/// What was learned of all T frames; rotation vectors in radians.
#[derive(Clone, Copy, Debug)]
pub struct Residuals<'a, T> {
    /// T: turns the whole hand in camera space.
    pub orient: &'a [[T; 3]],
    /// T × J: turns joints in their own frames.
    pub fingers: &'a [[T; 3]],
    /// J: added to the fingers of every frame.
    pub bias: &'a [[T; 3]],
    /// T.
    pub ray: &'a [[T; 2]],
    /// T.
    pub log_depth: &'a [T],
}

/// The grasps of a hand, G of them, and the object in the B frames that are asked for.
#[derive(Clone, Copy, Debug)]
pub struct Held<'a, T> {
    /// T: each frame's grasp, below 0 for none.
    pub of_frame: &'a [i64],
    /// What the residuals of a frame in a grasp are multiplied by.
    pub slack: T,
    /// Whether rotations are relative to the object as the mirror of the plane x = 0 shows it.
    pub mirrored: bool,
    /// G rotations in the object's frame.
    pub base_orient: &'a [[T; 9]],
    /// G × J.
    pub base_fingers: &'a [[T; 9]],
    /// G wrists in the object's frame.
    pub base_position: &'a [[T; 3]],
    /// G rotation vectors.
    pub orient: &'a [[T; 3]],
    /// G × J.
    pub fingers: &'a [[T; 3]],
    /// G.
    pub position: &'a [[T; 3]],
    /// B rotations of the object.
    pub rotations: &'a [[T; 9]],
    /// B.
    pub centers: &'a [[T; 3]],
    /// For the whole clip.
    pub scale: T,
}

/// A hand in B frames of a clip.
#[derive(Clone, Copy, Debug)]
pub struct HandPoses<'a, T> {
    /// B of the T frames.
    pub frames: &'a [usize],
    /// Where frames outside grasps start.
    pub start: Start<'a, T>,
    /// What was learned of frames.
    pub residuals: Residuals<'a, T>,
    /// Without it no frame belongs to a grasp.
    pub held: Option<Held<'a, T>>,
}

/// What the mirror of the plane x = 0 makes of a rotation.
fn mirrored<T: Real>(m: &Mat3<T>) -> Mat3<T> {
    let [[a, b, c], [d, e, f], [g, h, i]] = *m;
    [[a, -b, -c], [-d, e, f], [-g, h, i]]
}

impl<T: Real> Held<'_, T> {
    fn check(&self, frames: &[usize], clip: usize, joints: usize) -> Result<(), OpsError> {
        let grasps = self.base_orient.len();
        check_length("of_frame", clip, self.of_frame.len())?;
        check_length("base_fingers", grasps * joints, self.base_fingers.len())?;
        check_length("base_position", grasps, self.base_position.len())?;
        check_length("grasps' orient", grasps, self.orient.len())?;
        check_length("grasps' fingers", grasps * joints, self.fingers.len())?;
        check_length("grasps' position", grasps, self.position.len())?;
        check_length("rotations", frames.len(), self.rotations.len())?;
        check_length("centers", frames.len(), self.centers.len())?;
        let numbers = self.of_frame.iter().filter_map(|&g| usize::try_from(g).ok());
        match numbers.max() {
            Some(most) if most >= grasps => Err(OpsError::BadSize {
                name: "of_frame",
                expected: "numbers of grasps",
                got: most,
            }),
            _ => Ok(()),
        }
    }

    /// A rotation of the object as the hand sees it.
    fn seen(&self, rotation: &Mat3<T>) -> Mat3<T> {
        if self.mirrored {
            mirrored(rotation)
        } else {
            *rotation
        }
    }

    /// The wrist of a grasp in the object's frame.
    fn place(&self, grasp: usize) -> Vec3<T> {
        plus(self.base_position[grasp], self.position[grasp])
    }
}

impl<T: Real> HandPoses<'_, T> {
    /// J.
    fn joints(&self) -> usize {
        self.residuals.bias.len()
    }

    fn check(&self) -> Result<(), OpsError> {
        let (clip, joints) = (self.start.orient.len(), self.joints());
        check_length("base_pose", clip * joints, self.start.fingers.len())?;
        check_length("base_ray", clip, self.start.ray.len())?;
        check_length("base_log_depth", clip, self.start.log_depth.len())?;
        check_length("orient", clip, self.residuals.orient.len())?;
        check_length("pose", clip * joints, self.residuals.fingers.len())?;
        check_length("ray", clip, self.residuals.ray.len())?;
        check_length("log_depth", clip, self.residuals.log_depth.len())?;
        if let Some(&frame) = self.frames.iter().find(|&&frame| frame >= clip) {
            return Err(OpsError::BadSize {
                name: "frames",
                expected: "frames of the clip",
                got: frame,
            });
        }
        self.held
            .map_or(Ok(()), |held| held.check(self.frames, clip, joints))
    }
}

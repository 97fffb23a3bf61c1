//! Rotation vectors to matrices, and a joint tree from the rotations of its joints; back for gradients.

use bigs_raster::Real;
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;
use crate::mat3::{
    Mat3, Vec3, add, add_outer, apply, flat, matrix, minus, product, rotation, rotation_vjp, transposed,
};

/// Matrices, row by row, of rotation vectors in radians (Rodrigues' formula).
#[must_use]
pub fn rotations<T: Real>(vectors: &[[T; 3]]) -> Vec<[T; 9]> {
    vectors.iter().map(|&vector| flat(&rotation(vector))).collect()
}

/// Gradients of the vectors from those of the matrices.
///
/// # Errors
/// Another number of gradients than vectors.
pub fn rotations_vjp<T: Real>(vectors: &[[T; 3]], v: &[[T; 9]]) -> Result<Vec<[T; 3]>, OpsError> {
    check_length("v_matrices", vectors.len(), v.len())?;
    let each = vectors.iter().zip(v);
    Ok(each
        .map(|(&vector, v)| rotation_vjp(vector, &matrix(v)))
        .collect())
}

/// A tree of K joints in B frames.
#[derive(Clone, Copy, Debug)]
pub struct Tree<'a, T> {
    /// K: the joint before each; the first has none, every other a smaller number than its own.
    pub parents: &'a [usize],
    /// B × K rotations relative to the joint before, row by row.
    pub rotations: &'a [[T; 9]],
    /// K places at rest, or B × K.
    pub rest: &'a [[T; 3]],
    /// B: where the first joint comes to lie.
    pub root: &'a [[T; 3]],
}

/// B × K places, and B × K transforms from rest, four rows of four.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct PosedTree<T> {
    pub joints: Vec<[T; 3]>,
    pub bones: Vec<[T; 16]>,
}

/// Gradients of a tree's arrays.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct TreeGradients<T> {
    pub rotations: Vec<[T; 9]>,
    pub rest: Vec<[T; 3]>,
    pub root: Vec<[T; 3]>,
}

impl<T: Real> Tree<'_, T> {
    fn check(&self) -> Result<(), OpsError> {
        let (joints, frames) = (self.parents.len(), self.root.len());
        let forward = self
            .parents
            .iter()
            .enumerate()
            .skip(1)
            .find(|&(at, &parent)| parent >= at);
        if let Some((_, &parent)) = forward {
            return Err(OpsError::BadSize {
                name: "parents",
                expected: "smaller numbers than their joints' own",
                got: parent,
            });
        }
        check_length("rotations", frames * joints, self.rotations.len())?;
        if self.rest.len() != joints {
            check_length("rest_joints", frames * joints, self.rest.len())?;
        }
        Ok(())
    }

    /// Places at rest in a frame.
    fn rest(&self, frame: usize) -> &[[T; 3]] {
        let joints = self.parents.len();
        if self.rest.len() == joints {
            self.rest
        } else {
            &self.rest[frame * joints..][..joints]
        }
    }

    /// Turns of all joints in camera space, in a frame.
    fn turns(&self, frame: usize) -> Vec<Mat3<T>> {
        let joints = self.parents.len();
        let own = &self.rotations[frame * joints..][..joints];
        let mut turns: Vec<Mat3<T>> = Vec::with_capacity(joints);
        for (joint, rotation) in own.iter().enumerate() {
            let rotation = matrix(rotation);
            turns.push(if joint == 0 {
                rotation
            } else {
                product(&turns[self.parents[joint]], &rotation)
            });
        }
        turns
    }

    /// Places and transforms of all joints.
    ///
    /// # Errors
    /// A length that does not fit, or a joint that comes before its parent.
    pub fn pose(&self) -> Result<PosedTree<T>, OpsError> {
        self.check()?;
        let joints = self.parents.len();
        let mut out = PosedTree {
            joints: vec![[T::ZERO; 3]; self.rotations.len()],
            bones: vec![[T::ZERO; 16]; self.rotations.len()],
        };
        let each = joints.max(1);
        for (frame, (places, bones)) in out
            .joints
            .chunks_exact_mut(each)
            .zip(out.bones.chunks_exact_mut(each))
            .enumerate()
        {
            let (rest, turns) = (self.rest(frame), self.turns(frame));
            for joint in 0..joints {
                places[joint] = self.root[frame];
                if joint > 0 {
                    let parent = self.parents[joint];
                    places[joint] = apply(&turns[parent], minus(rest[joint], rest[parent]));
                    let before = places[parent];
                    add(&mut places[joint], before);
                }
                let moved = minus(places[joint], apply(&turns[joint], rest[joint]));
                for i in 0..3 {
                    bones[joint][4 * i..][..3].copy_from_slice(&turns[joint][i]);
                    bones[joint][4 * i + 3] = moved[i];
                }
                bones[joint][15] = T::ONE;
            }
        }
        Ok(out)
    }

    /// Gradients from those of the places and transforms, `None` for zeros.
    ///
    /// # Errors
    /// As [`Tree::pose`], or gradients of another length.
    pub fn vjp(
        &self,
        v_joints: Option<&[[T; 3]]>,
        v_bones: Option<&[[T; 16]]>,
    ) -> Result<TreeGradients<T>, OpsError> {
        self.check()?;
        let total = self.rotations.len();
        check_length("v_joints", total, v_joints.map_or(total, <[_]>::len))?;
        check_length("v_bones", total, v_bones.map_or(total, <[_]>::len))?;
        let joints = self.parents.len();
        type Frame<T> = (Vec<[T; 9]>, Vec<Vec3<T>>, Vec3<T>);
        let frames: Vec<Frame<T>> = (0..self.root.len())
            .into_par_iter()
            .map(|frame| {
                let (rest, turns) = (self.rest(frame), self.turns(frame));
                let mut v_places = vec![[T::ZERO; 3]; joints];
                let mut v_turns = vec![[[T::ZERO; 3]; 3]; joints];
                let mut v_rest = vec![[T::ZERO; 3]; joints];
                let mut v_rotations = vec![[T::ZERO; 9]; joints];
                for joint in 0..joints {
                    if let Some(v) = v_joints {
                        v_places[joint] = v[frame * joints + joint];
                    }
                    if let Some(v) = v_bones {
                        let v = &v[frame * joints + joint];
                        let v_moved = [v[3], v[7], v[11]];
                        v_turns[joint] = [0, 1, 2].map(|i| [v[4 * i], v[4 * i + 1], v[4 * i + 2]]);
                        add_outer(&mut v_turns[joint], -T::ONE, v_moved, rest[joint]);
                        add(&mut v_places[joint], v_moved);
                        v_rest[joint] = apply(&transposed(&turns[joint]), v_moved.map(|v| -v));
                    }
                }
                for joint in (0..joints).rev() {
                    let mut v_rotation = v_turns[joint];
                    if joint > 0 {
                        let parent = self.parents[joint];
                        let (v_place, back) = (v_places[joint], transposed(&turns[parent]));
                        add(&mut v_places[parent], v_place);
                        let bone = minus(rest[joint], rest[parent]);
                        add_outer(&mut v_turns[parent], T::ONE, v_place, bone);
                        let v_bone = apply(&back, v_place);
                        add(&mut v_rest[joint], v_bone);
                        add(&mut v_rest[parent], v_bone.map(|v| -v));
                        let own = transposed(&matrix(&self.rotations[frame * joints + joint]));
                        let v_parent = product(&v_rotation, &own);
                        for i in 0..3 {
                            add(&mut v_turns[parent][i], v_parent[i]);
                        }
                        v_rotation = product(&back, &v_rotation);
                    }
                    v_rotations[joint].copy_from_slice(v_rotation.as_flattened());
                }
                let v_root = v_places.first().copied().unwrap_or([T::ZERO; 3]);
                (v_rotations, v_rest, v_root)
            })
            .collect();
        let mut out = TreeGradients {
            rotations: Vec::with_capacity(total),
            rest: vec![[T::ZERO; 3]; self.rest.len()],
            root: Vec::with_capacity(frames.len()),
        };
        for (frame, (rotations, rest, root)) in frames.into_iter().enumerate() {
            out.rotations.extend(rotations);
            out.root.push(root);
            let first = if self.rest.len() == joints {
                0
            } else {
                frame * joints
            };
            for (sum, v) in out.rest[first..].iter_mut().zip(rest) {
                add(sum, v);
            }
        }
        Ok(out)
    }
}

//! Gradients of what was posed, and those of a subject from those of its chunks.

use bigs_raster::Vectors;

use crate::pose::Subject;
use crate::pose::backward::ChunkGradients;
use crate::pose::bones::{Bone, Bones};
use crate::pose::light::CLIP;

/// Which gradients of a subject are wanted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wanted {
    /// Of rest points.
    pub points: bool,
    /// Of skinning weights.
    pub weights: bool,
    /// Of bones.
    pub bones: bool,
    /// Of quaternions.
    pub quats: bool,
    /// Of albedos.
    pub albedo: bool,
    /// Of shade and of the strength of ambient occlusion; the clip's light comes with them.
    pub light: bool,
}

/// Gradients of a subject's arrays; empty where not wanted.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct SubjectGradients<T> {
    pub points: Vec<[T; 3]>,
    pub weights: Vec<T>,
    pub bones: Vec<T>,
    pub quats: Vec<[T; 4]>,
    pub albedo: Vec<[T; 3]>,
    pub shade: Vec<T>,
    pub strength: [T; 3],
}

/// Gradients of all that was posed.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseGradients<T> {
    /// In the order of the subjects.
    pub subjects: Vec<SubjectGradients<T>>,
    /// Of the clip's light.
    pub clip: [[T; 3]; CLIP],
}

/// A subject's gradients from those of its chunks, summed in their order.
pub(super) fn joined<T: Vectors>(
    chunks: &[&ChunkGradients<T>],
    subject: &Subject<'_, T>,
    frames: usize,
    bones: &Bones<T>,
    wanted: Wanted,
) -> SubjectGradients<T> {
    let mut out = SubjectGradients {
        points: Vec::new(),
        weights: Vec::new(),
        bones: Vec::new(),
        quats: Vec::new(),
        albedo: Vec::new(),
        shade: Vec::new(),
        strength: [T::ZERO; 3],
    };
    if wanted.points && subject.moves() {
        out.points = vec![[T::ZERO; 3]; frames * subject.count];
        let mut first = 0;
        for chunk in chunks {
            let len = chunk.points.len() / frames.max(1);
            for frame in 0..frames {
                out.points[frame * subject.count + first..][..len]
                    .copy_from_slice(&chunk.points[frame * len..][..len]);
            }
            first += len;
        }
    }
    if let (Some(light), true) = (subject.surface.and_then(|surface| surface.light), wanted.light) {
        out.shade = vec![T::ZERO; light.shade.len()];
    }
    let mut v_bones: Vec<Bone<T>> = vec![[T::ZERO; 16]; if wanted.bones { frames * bones.count } else { 0 }];
    for chunk in chunks {
        if !subject.moves() {
            out.points.extend_from_slice(&chunk.points);
        }
        out.weights.extend_from_slice(&chunk.weights);
        out.quats.extend_from_slice(&chunk.quats);
        out.albedo.extend_from_slice(&chunk.albedo);
        add_all(&mut out.shade, &chunk.shade);
        if wanted.light {
            add_all(&mut out.strength, &chunk.strength);
        }
        add_all(v_bones.as_flattened_mut(), chunk.bones.as_flattened());
    }
    out.bones = bones.vjp(&v_bones, subject.bone_size);
    out
}

pub(super) fn add_all<T: Vectors>(sums: &mut [T], values: &[T]) {
    for (sum, &value) in sums.iter_mut().zip(values) {
        *sum += value;
    }
}

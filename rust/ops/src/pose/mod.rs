//! Gaussians of hands and of an object carried to the frames of a step: linear blend skinning of centres and rotations,
//! the mirror for a left hand, light and shade; and back for gradients.
//!
//! An object is a subject with one bone and weights of 1.

mod backward;
mod bones;
mod chunk;
mod forward;
mod gradients;
mod light;

use bigs_raster::{SimdLevel, Vectors, filled_with};
use rayon::prelude::*;

use crate::OpsError;
use crate::checks::check_length;
use crate::pose::backward::{Backward, ChunkGradients, Pulls};
use crate::pose::bones::Bones;
use crate::pose::chunk::CHUNK;
use crate::pose::forward::{Forward, Posed};
use crate::pose::gradients::{add_all, joined};
use crate::pose::light::CLIP;

pub use gradients::{PoseGradients, SubjectGradients, Wanted};

/// One subject's Gaussians, N of them, and its K bones in every one of B frames.
#[derive(Clone, Copy, Debug)]
pub struct Subject<'a, T> {
    /// N.
    pub count: usize,
    /// Rest points, N, or B × N where a pose changes them.
    pub points: &'a [[T; 3]],
    /// N × K: how far a bone carries a point.
    pub weights: &'a [T],
    /// B × K matrices of `bone_size` entries, row by row: rotation and translation.
    pub bones: &'a [T],
    /// 12, or 16 with a last row that is not read.
    pub bone_size: usize,
    /// Whether to show what the mirror of the plane x = 0 shows.
    pub mirrored: bool,
    /// What there is besides centres.
    pub surface: Option<Surface<'a, T>>,
}

/// Orientations and colours of a subject.
#[derive(Clone, Copy, Debug)]
pub struct Surface<'a, T> {
    /// N, w x y z, of any length.
    pub quats: &'a [[T; 4]],
    /// N colours without light.
    pub albedo: &'a [[T; 3]],
    /// None leaves colours as they are.
    pub light: Option<Light<'a, T>>,
}

/// The light of every frame on a subject with J parts.
#[derive(Clone, Copy, Debug)]
pub struct Light<'a, T> {
    /// J.
    pub parts_each: usize,
    /// N × J: how far a Gaussian belongs to a part.
    pub parts: &'a [T],
    /// B × (4 + J): a constant, a slope along the normal, and a constant for each part.
    pub shade: &'a [T],
    /// None where nothing takes light from a Gaussian.
    pub ambient: Option<Ambient<'a, T>>,
}

/// What surfaces near a Gaussian take of its light.
#[derive(Clone, Copy, Debug)]
pub struct Ambient<'a, T> {
    /// B × N: the share of the sky that they cover (see [`crate::occlusion`]).
    pub occlusion: &'a [T],
    /// The logarithm of a colour's factor where all of the sky is covered.
    pub strength: [T; 3],
}

impl<'a, T> Light<'a, T> {
    fn of_frame(&self, frame: usize) -> &'a [T] {
        &self.shade[frame * (4 + self.parts_each)..][..4 + self.parts_each]
    }
}

impl<T: Vectors> Light<'_, T> {
    fn strength(&self) -> [T; 3] {
        self.ambient.map_or([T::ZERO; 3], |ambient| ambient.strength)
    }
}

impl<T> Subject<'_, T> {
    /// K.
    fn bones_each(&self, frames: usize) -> usize {
        self.bones.len() / (frames * self.bone_size).max(1)
    }

    /// Whether rest points differ from frame to frame.
    fn moves(&self) -> bool {
        self.points.len() != self.count
    }
}

/// Subjects in B frames.
#[derive(Debug)]
pub struct Pose<'a, T> {
    frames: usize,
    subjects: Vec<Subject<'a, T>>,
    clip: [[T; 3]; CLIP],
    labels: bool,
}

/// All subjects' Gaussians, one after the other in every frame.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedGaussians<T> {
    /// B × N.
    pub means: Vec<[T; 3]>,
    /// B × N, of any length; none where no subject has a surface.
    pub quats: Vec<[T; 4]>,
    /// B × N × (3, or 3 and a label for each subject); none likewise.
    pub colors: Vec<T>,
}

impl<'a, T: Vectors> Pose<'a, T> {
    /// Checks lengths.
    ///
    /// * `clip`: eight rows, the light of the whole clip; without it no subject has light
    /// * `labels`: whether colours go on with a channel for each subject
    ///
    /// # Errors
    /// A length that does not fit, or subjects with and without a surface.
    pub fn new(
        frames: usize,
        subjects: Vec<Subject<'a, T>>,
        clip: Option<&[[T; 3]]>,
        labels: bool,
    ) -> Result<Self, OpsError> {
        for subject in &subjects {
            let n = subject.count;
            if subject.points.len() != n {
                check_length("points", frames * n, subject.points.len())?;
            }
            if subject.bone_size != 12 {
                check_length("bones", 16, subject.bone_size)?;
            }
            let bones = subject.bones_each(frames);
            check_length("bones", frames * bones * subject.bone_size, subject.bones.len())?;
            check_length("weights", n * bones, subject.weights.len())?;
            let with = subjects
                .iter()
                .filter(|subject| subject.surface.is_some())
                .count();
            check_length("surfaces", if with == 0 { 0 } else { subjects.len() }, with)?;
            if let Some(surface) = &subject.surface {
                check_length("quats", n, surface.quats.len())?;
                check_length("albedo", n, surface.albedo.len())?;
                if let Some(light) = &surface.light {
                    check_length("parts", n * light.parts_each, light.parts.len())?;
                    check_length("shade", frames * (4 + light.parts_each), light.shade.len())?;
                    check_length("clip", CLIP, clip.map_or(0, <[_]>::len))?;
                    if let Some(ambient) = &light.ambient {
                        check_length("occlusion", frames * n, ambient.occlusion.len())?;
                    }
                }
            }
        }
        let mut own = [[T::ZERO; 3]; CLIP];
        if let Some(clip) = clip {
            check_length("clip", CLIP, clip.len())?;
            own.copy_from_slice(clip);
        }
        Ok(Self {
            frames,
            subjects,
            clip: own,
            labels,
        })
    }

    /// Gaussians of all subjects in a frame.
    #[must_use]
    pub fn total(&self) -> usize {
        self.subjects.iter().map(|subject| subject.count).sum()
    }

    /// Values of a colour: three, and with labels one for each subject.
    #[must_use]
    pub fn channels(&self) -> usize {
        3 + if self.labels { self.subjects.len() } else { 0 }
    }

    fn has_surface(&self) -> bool {
        self.subjects.iter().any(|subject| subject.surface.is_some())
    }

    fn bones(&self) -> Vec<Bones<T>> {
        self.subjects
            .iter()
            .map(|subject| {
                let count = subject.bones_each(self.frames);
                Bones::new(subject.bones, count, subject.bone_size, subject.surface.is_some())
            })
            .collect()
    }

    /// Subject and first Gaussian of every chunk, in order.
    fn chunks(&self) -> Vec<(usize, usize)> {
        let of = |(index, subject): (usize, &Subject<'a, T>)| {
            (0..subject.count).step_by(CHUNK).map(move |first| (index, first))
        };
        self.subjects.iter().enumerate().flat_map(of).collect()
    }

    /// The lengths of the chunks.
    fn lengths(&self, chunks: &[(usize, usize)]) -> Vec<usize> {
        chunks
            .iter()
            .map(|&(index, first)| CHUNK.min(self.subjects[index].count - first))
            .collect()
    }

    /// The Gaussians in camera space.
    ///
    /// # Errors
    /// `BIGS_RASTER_SIMD` names no level of this machine.
    pub fn forward(&self) -> Result<PosedGaussians<T>, OpsError> {
        let level = SimdLevel::chosen()?;
        let (total, channels) = (self.total(), self.channels());
        let shown = if self.has_surface() {
            self.frames * total
        } else {
            0
        };
        let mut out = PosedGaussians {
            means: filled_with("means", [T::ZERO; 3], &[self.frames, total])?,
            quats: filled_with("quats", [T::ZERO; 4], &[shown])?,
            colors: filled_with("colors", T::ZERO, &[shown, channels])?,
        };
        let (bones, chunks) = (self.bones(), self.chunks());
        let lengths = self.lengths(&chunks);
        let tasks = (
            by_chunk(&mut out.means, total, &lengths, 1),
            by_chunk(&mut out.quats, total, &lengths, 1),
            by_chunk(&mut out.colors, total, &lengths, channels),
        );
        (chunks, tasks.0, tasks.1, tasks.2).into_par_iter().for_each(
            |((index, first), means, quats, colors)| {
                level.run(Forward {
                    subject: &self.subjects[index],
                    bones: &bones[index],
                    clip: &self.clip,
                    first,
                    out: Posed { means, quats, colors },
                    channels,
                    label: index,
                });
            },
        );
        Ok(out)
    }

    /// Gradients of a loss from those of the posed Gaussians, `None` for zeros: each subject's, and the clip's light.
    ///
    /// # Errors
    /// A gradient of another length than what [`Pose::forward`] gives, another number of `wanted` than subjects, or a level
    /// that this machine does not have.
    pub fn vjp(
        &self,
        v_means: Option<&[[T; 3]]>,
        v_quats: Option<&[[T; 4]]>,
        v_colors: Option<&[T]>,
        wanted: &[Wanted],
    ) -> Result<PoseGradients<T>, OpsError> {
        let level = SimdLevel::chosen()?;
        let (total, channels) = (self.total(), self.channels());
        let shown = if self.has_surface() {
            self.frames * total
        } else {
            0
        };
        check_length("wanted", self.subjects.len(), wanted.len())?;
        check_length(
            "v_means",
            self.frames * total,
            v_means.map_or(self.frames * total, <[_]>::len),
        )?;
        check_length("v_quats", shown, v_quats.map_or(shown, <[_]>::len))?;
        check_length(
            "v_colors",
            shown * channels,
            v_colors.map_or(shown * channels, <[_]>::len),
        )?;
        let (bones, chunks) = (self.bones(), self.chunks());
        let lengths = self.lengths(&chunks);
        let mut before = 0;
        let places: Vec<usize> = lengths
            .iter()
            .map(|len| {
                before += len;
                before - len
            })
            .collect();
        let found: Vec<ChunkGradients<T>> = (&chunks, &lengths, &places)
            .into_par_iter()
            .map(|(&(index, first), &len, &before)| {
                level.run(Backward {
                    subject: &self.subjects[index],
                    bones: &bones[index],
                    clip: &self.clip,
                    first,
                    len,
                    frames: self.frames,
                    pulls: Pulls {
                        means: v_means,
                        quats: v_quats,
                        colors: v_colors,
                        total,
                        before,
                        channels,
                    },
                    wanted: wanted[index],
                })
            })
            .collect();
        let mut clip = [[T::ZERO; 3]; CLIP];
        let mut gradients = Vec::with_capacity(self.subjects.len());
        for (index, subject) in self.subjects.iter().enumerate() {
            let own: Vec<&ChunkGradients<T>> = chunks
                .iter()
                .zip(&found)
                .filter_map(|(&(of, _), gradients)| (of == index).then_some(gradients))
                .collect();
            if wanted[index].light {
                for chunk in &own {
                    add_all(clip.as_flattened_mut(), chunk.clip.as_flattened());
                }
            }
            gradients.push(joined(&own, subject, self.frames, &bones[index], wanted[index]));
        }
        Ok(PoseGradients {
            subjects: gradients,
            clip,
        })
    }
}

/// Pieces of an array of frames × `total` × `each`: for every chunk its piece of each frame. Nothing of an empty array.
fn by_chunk<'a, U>(
    values: &'a mut [U],
    total: usize,
    lengths: &[usize],
    each: usize,
) -> Vec<Vec<&'a mut [U]>> {
    let mut pieces: Vec<Vec<&mut [U]>> = lengths.iter().map(|_| Vec::new()).collect();
    if values.is_empty() {
        return pieces;
    }
    for mut frame in values.chunks_exact_mut(total * each) {
        for (piece, len) in pieces.iter_mut().zip(lengths) {
            let (own, rest) = frame.split_at_mut(len * each);
            piece.push(own);
            frame = rest;
        }
    }
    pieces
}

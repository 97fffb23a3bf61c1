//! The gradients of one chunk of Gaussians, from those of what they became in every frame.

use bigs_raster::{Simd, Vectors, Work};

use crate::lanes::{Lanes, conjugate, product};
use crate::pose::bones::{Bone, Bones};
use crate::pose::chunk::{
    CHUNK, FrameLight, Inputs, Lit, Row, add, blend, load, mirror_point, mirror_turn, occlusion, points,
    rows, store, write,
};
use crate::pose::light::{CLIP, basis_vjp};
use crate::pose::{Subject, Wanted};

/// Gradients of what a chunk became; `None` for zeros.
pub(super) struct Pulls<'a, T> {
    pub(super) means: Option<&'a [[T; 3]]>,
    pub(super) quats: Option<&'a [[T; 4]]>,
    pub(super) colors: Option<&'a [T]>,
    /// Gaussians of all subjects in a frame, and those before the chunk.
    pub(super) total: usize,
    pub(super) before: usize,
    pub(super) channels: usize,
}

impl<T: Vectors> Pulls<'_, T> {
    fn colors(&self, frame: usize, len: usize) -> [Row<T>; 3] {
        let mut rows = [[T::ZERO; CHUNK]; 3];
        if let Some(colors) = self.colors {
            let own = &colors[(frame * self.total + self.before) * self.channels..][..len * self.channels];
            for (i, value) in own.chunks_exact(self.channels).enumerate() {
                for c in 0..3 {
                    rows[c][i] = value[c];
                }
            }
        }
        rows
    }

    fn some<const D: usize>(&self, values: Option<&[[T; D]]>, frame: usize, len: usize) -> [Row<T>; D] {
        values.map_or([[T::ZERO; CHUNK]; D], |values| {
            rows(&values[frame * self.total + self.before..][..len])
        })
    }
}

/// Gradients of one chunk: its own Gaussians', and its share of what all chunks have in common.
pub(super) struct ChunkGradients<T> {
    /// One for each Gaussian, or for each frame and Gaussian.
    pub(super) points: Vec<[T; 3]>,
    pub(super) weights: Vec<T>,
    pub(super) quats: Vec<[T; 4]>,
    pub(super) albedo: Vec<[T; 3]>,
    pub(super) bones: Vec<Bone<T>>,
    pub(super) shade: Vec<T>,
    pub(super) clip: [[T; 3]; CLIP],
    /// Of the strength of ambient occlusion.
    pub(super) strength: [T; 3],
}

pub(super) struct Backward<'a, T> {
    pub(super) subject: &'a Subject<'a, T>,
    pub(super) bones: &'a Bones<T>,
    pub(super) clip: &'a [[T; 3]; CLIP],
    pub(super) first: usize,
    pub(super) len: usize,
    pub(super) frames: usize,
    pub(super) pulls: Pulls<'a, T>,
    pub(super) wanted: Wanted,
}

/// The gradient of blended weights with respect to the weights or the bones they were made of.
struct Blended<T> {
    /// Of the sixteen blended values, by Gaussian.
    rows: [Row<T>; 16],
}

impl<T: Vectors> Blended<T> {
    /// Adds the gradients of bones: sums over the Gaussians of weight times gradient.
    #[inline(always)]
    fn add_to_bones<S: Simd>(&self, simd: S, weights: &[Row<T>], len: usize, out: &mut [Bone<T>]) {
        for (weights, bone) in weights.iter().zip(out) {
            let mut sums = [Lanes::<T, S>::zero(simd); 16];
            for at in (0..len).step_by(Lanes::<T, S>::COUNT) {
                let weight = Lanes::load(simd, &weights[at..]);
                for c in 0..16 {
                    sums[c] = weight.times_plus(Lanes::load(simd, &self.rows[c][at..]), sums[c]);
                }
            }
            for (value, sum) in bone.iter_mut().zip(Lanes::sums(&sums)) {
                *value += sum;
            }
        }
    }

    #[inline(always)]
    fn add_to_weights<S: Simd>(&self, simd: S, bones: &[Bone<T>], len: usize, out: &mut [Row<T>]) {
        for (bone, row) in bones.iter().zip(out) {
            for at in (0..len).step_by(Lanes::<T, S>::COUNT) {
                let mut sum = Lanes::load(simd, &row[at..]);
                for c in 0..16 {
                    let v = Lanes::load(simd, &self.rows[c][at..]);
                    sum = v.times_plus(Lanes::splat(simd, bone[c]), sum);
                }
                sum.store(&mut row[at..]);
            }
        }
    }
}

/// Sums over the Gaussians of a chunk, lane by lane.
struct Sums<T: Vectors, S: Simd> {
    /// Constant and slope of the frame's shade.
    shade: [Lanes<T, S>; 4],
    clip: [[Lanes<T, S>; CLIP]; 3],
    strength: [Lanes<T, S>; 3],
}

impl<T: Vectors> Work for Backward<'_, T> {
    type Output = ChunkGradients<T>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> ChunkGradients<T> {
        let (subject, first, len, frames, wanted) =
            (self.subject, self.first, self.len, self.frames, self.wanted);
        let inputs = Inputs::of(subject, self.bones.count, first, len);
        let light = subject
            .surface
            .as_ref()
            .and_then(|surface| surface.light.as_ref());
        let zeros = |wanted: bool, count: usize| vec![T::ZERO; if wanted { count } else { 0 }];
        let shades = light.map_or(0, |light| 4 + light.parts_each);
        let mut out = ChunkGradients {
            points: Vec::with_capacity(len * if subject.moves() { frames } else { 1 }),
            weights: Vec::new(),
            quats: Vec::new(),
            albedo: Vec::new(),
            bones: vec![
                [T::ZERO; 16];
                if wanted.bones {
                    frames * self.bones.count
                } else {
                    0
                }
            ],
            shade: zeros(wanted.light, frames * shades),
            clip: [[T::ZERO; 3]; CLIP],
            strength: [T::ZERO; 3],
        };
        let mut v_points = [[T::ZERO; CHUNK]; 3];
        let mut v_weights = vec![[T::ZERO; CHUNK]; if wanted.weights { self.bones.count } else { 0 }];
        let (mut v_quats, mut v_albedo) = ([[T::ZERO; CHUNK]; 4], [[T::ZERO; CHUNK]; 3]);
        let mut v_blended = Blended {
            rows: [[T::ZERO; CHUNK]; 16],
        };
        let mut v_shaded = [T::ZERO; CHUNK];
        let mut clip_sums = [[Lanes::<T, S>::zero(simd); CLIP]; 3];
        let mut strength_sums = [Lanes::<T, S>::zero(simd); 3];
        let mut at_rest = rows(points(subject, 0, first, len));
        for frame in 0..frames {
            if subject.moves() && frame > 0 {
                at_rest = rows(points(subject, frame, first, len));
            }
            let bones = self.bones.of_frame(frame);
            let v_means = self.pulls.some(self.pulls.means, frame, len);
            let v_turned = self.pulls.some(self.pulls.quats, frame, len);
            let v_colors = self.pulls.colors(frame, len);
            let mut sums = Sums {
                shade: [Lanes::<T, S>::zero(simd); 4],
                clip: clip_sums,
                strength: strength_sums,
            };
            let covered = occlusion(subject, frame, first, len);
            let light = light.map(|light| FrameLight::of(light, self.clip, frame, &inputs.parts, &covered));
            for at in (0..len).step_by(Lanes::<T, S>::COUNT) {
                let [x, y, z] = load(simd, &at_rest, at);
                let v_mean = mirror_point(load(simd, &v_means, at), subject.mirrored);
                let blended = blend::<T, S, 16>(simd, &inputs.weights, bones, at);
                for i in 0..3 {
                    let v = v_mean[i];
                    for (j, value) in [v * x, v * y, v * z, v].into_iter().enumerate() {
                        value.store(&mut v_blended.rows[4 * i + j][at..]);
                    }
                }
                if wanted.points {
                    let mut v = v_mean;
                    for j in 0..3 {
                        v[j] =
                            blended[j] * v_mean[0] + blended[4 + j] * v_mean[1] + blended[8 + j] * v_mean[2];
                    }
                    if subject.moves() {
                        store(v, &mut v_points, at);
                    } else {
                        add(simd, v, &mut v_points, at);
                    }
                }
                if subject.surface.is_none() {
                    continue;
                }
                let [.., w, x, y, z] = blended;
                let (bone, quat) = ([w, x, y, z], load(simd, &inputs.quats, at));
                let mut v_turn: [_; 4] = load(simd, &v_turned, at);
                let v_color: [_; 3] = load(simd, &v_colors, at);
                if let Some(light) = &light {
                    let turned = mirror_turn(product(bone, quat), subject.mirrored);
                    let lit = Lit::of(simd, turned, light, at);
                    let mut v_power = v_color;
                    for c in 0..3 {
                        v_power[c] = v_color[c] * lit.factor[c];
                    }
                    if wanted.albedo {
                        add(simd, v_power, &mut v_albedo, at);
                    }
                    let albedo: [_; 3] = load(simd, &inputs.albedo, at);
                    for c in 0..3 {
                        v_power[c] = v_power[c] * albedo[c];
                    }
                    let shared = v_power[0] + v_power[1] + v_power[2];
                    shared.store(&mut v_shaded[at..]);
                    let axis = lit.normal.axis;
                    sums.shade[0] = sums.shade[0] + shared;
                    for i in 0..3 {
                        sums.shade[1 + i] = axis[i].times_plus(shared, sums.shade[1 + i]);
                    }
                    let covered = Lanes::load(simd, &covered[at..]);
                    for c in 0..3 {
                        sums.strength[c] = covered.times_plus(v_power[c], sums.strength[c]);
                    }
                    let mut v_basis = [Lanes::zero(simd); CLIP];
                    for b in 0..CLIP {
                        for c in 0..3 {
                            sums.clip[c][b] = lit.basis[b].times_plus(v_power[c], sums.clip[c][b]);
                            v_basis[b] =
                                v_power[c].times_plus(Lanes::splat(simd, self.clip[b][c]), v_basis[b]);
                        }
                    }
                    let mut v_axis = basis_vjp(simd, axis, v_basis);
                    for i in 0..3 {
                        v_axis[i] = shared.times_plus(Lanes::splat(simd, light.shade[1 + i]), v_axis[i]);
                    }
                    let v_normal = lit.normal.vjp(v_axis);
                    for i in 0..4 {
                        v_turn[i] = v_turn[i] + v_normal[i];
                    }
                } else if wanted.albedo {
                    add(simd, v_color, &mut v_albedo, at);
                }
                let v_turn = mirror_turn(v_turn, subject.mirrored);
                let v_bone = product(v_turn, conjugate(quat));
                for (j, value) in v_bone.into_iter().enumerate() {
                    value.store(&mut v_blended.rows[12 + j][at..]);
                }
                if wanted.quats {
                    add(simd, product(conjugate(bone), v_turn), &mut v_quats, at);
                }
            }
            clip_sums = sums.clip;
            strength_sums = sums.strength;
            if wanted.bones {
                let own = &mut out.bones[frame * self.bones.count..][..self.bones.count];
                v_blended.add_to_bones(simd, &inputs.weights, len, own);
            }
            if wanted.weights {
                v_blended.add_to_weights(simd, bones, len, &mut v_weights);
            }
            if wanted.light && shades > 0 {
                let own = &mut out.shade[frame * shades..][..shades];
                own[..4].copy_from_slice(&Lanes::sums(&sums.shade));
                for (value, part) in own[4..].iter_mut().zip(&inputs.parts) {
                    let mut sum = Lanes::<T, S>::zero(simd);
                    for at in (0..len).step_by(Lanes::<T, S>::COUNT) {
                        let v = Lanes::load(simd, &v_shaded[at..]);
                        sum = Lanes::load(simd, &part[at..]).times_plus(v, sum);
                    }
                    [*value] = Lanes::sums(&[sum]);
                }
            }
            if wanted.points && (subject.moves() || frame + 1 == frames) {
                let done = out.points.len();
                out.points.resize(done + len, [T::ZERO; 3]);
                write(&v_points, &mut out.points[done..]);
            }
        }
        for (c, sums) in clip_sums.iter().enumerate() {
            for (b, sum) in Lanes::sums(sums).into_iter().enumerate() {
                out.clip[b][c] = sum;
            }
        }
        out.strength = Lanes::sums(&strength_sums);
        if wanted.quats {
            out.quats.resize(len, [T::ZERO; 4]);
            write(&v_quats, &mut out.quats);
        }
        if wanted.albedo {
            out.albedo.resize(len, [T::ZERO; 3]);
            write(&v_albedo, &mut out.albedo);
        }
        for i in 0..if wanted.weights { len } else { 0 } {
            out.weights.extend(v_weights.iter().map(|row| row[i]));
        }
        out
    }
}

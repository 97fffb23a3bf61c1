//! The loops over one chunk of a subject's Gaussians, in vectors of the CPU's level.

use bigs_raster::{Simd, Vectors, Work};

use crate::lanes::{Four, LONGEST, Lanes, conjugate, product};
use crate::pose::bones::{Bone, Bones};
use crate::pose::light::{CLIP, Normal, basis, basis_vjp};
use crate::pose::{Subject, Wanted};

/// Gaussians of one task. Fixed, so that sums do not depend on the number of threads; whole vectors of every level.
pub(crate) const CHUNK: usize = 128;
const _: () = assert!(CHUNK.is_multiple_of(LONGEST));

/// One value of each Gaussian of a chunk.
type Row<T> = [T; CHUNK];

/// Rows of the values [first, first + len) of an array of `D` values each; zero beyond.
fn rows<T: Vectors, const D: usize>(values: &[[T; D]]) -> [Row<T>; D] {
    let mut rows = [[T::ZERO; CHUNK]; D];
    for (i, value) in values.iter().enumerate() {
        for d in 0..D {
            rows[d][i] = value[d];
        }
    }
    rows
}

/// The same where the number of values is known at run time.
fn some_rows<T: Vectors>(values: &[T], each: usize) -> Vec<Row<T>> {
    let mut rows = vec![[T::ZERO; CHUNK]; each];
    if each > 0 {
        for (i, value) in values.chunks_exact(each).enumerate() {
            for d in 0..each {
                rows[d][i] = value[d];
            }
        }
    }
    rows
}

fn write<T: Vectors, const D: usize>(rows: &[Row<T>; D], out: &mut [[T; D]]) {
    for (i, value) in out.iter_mut().enumerate() {
        for d in 0..D {
            value[d] = rows[d][i];
        }
    }
}

/// Loads `D` vectors from the same place of as many rows.
#[inline(always)]
fn load<T: Vectors, S: Simd, const D: usize>(simd: S, rows: &[Row<T>; D], at: usize) -> [Lanes<T, S>; D] {
    let mut out = [Lanes::zero(simd); D];
    for d in 0..D {
        out[d] = Lanes::load(simd, &rows[d][at..]);
    }
    out
}

#[inline(always)]
fn store<T: Vectors, S: Simd, const D: usize>(values: [Lanes<T, S>; D], rows: &mut [Row<T>; D], at: usize) {
    for d in 0..D {
        values[d].store(&mut rows[d][at..]);
    }
}

#[inline(always)]
fn add<T: Vectors, S: Simd, const D: usize>(
    simd: S,
    values: [Lanes<T, S>; D],
    rows: &mut [Row<T>; D],
    at: usize,
) {
    for d in 0..D {
        (Lanes::load(simd, &rows[d][at..]) + values[d]).store(&mut rows[d][at..]);
    }
}

/// What a chunk's Gaussians are, in rows.
struct Inputs<T> {
    weights: Vec<Row<T>>,
    quats: [Row<T>; 4],
    albedo: [Row<T>; 3],
    parts: Vec<Row<T>>,
}

impl<T: Vectors> Inputs<T> {
    fn of(subject: &Subject<'_, T>, bones: usize, first: usize, len: usize) -> Self {
        let surface = subject.surface.as_ref();
        let light = surface.and_then(|surface| surface.light.as_ref());
        Self {
            weights: some_rows(&subject.weights[first * bones..][..len * bones], bones),
            quats: surface.map_or([[T::ZERO; CHUNK]; 4], |s| rows(&s.quats[first..][..len])),
            albedo: surface.map_or([[T::ZERO; CHUNK]; 3], |s| rows(&s.albedo[first..][..len])),
            parts: light.map_or_else(Vec::new, |light| {
                let each = light.parts.len() / subject.count.max(1);
                some_rows(&light.parts[first * each..][..len * each], each)
            }),
        }
    }
}

/// The rest points of a chunk in one frame.
fn points<'a, T>(subject: &Subject<'a, T>, frame: usize, first: usize, len: usize) -> &'a [[T; 3]] {
    let before = if subject.moves() { frame * subject.count } else { 0 };
    &subject.points[before + first..][..len]
}

/// Bones blended by the weights of the Gaussians at `at`.
#[inline(always)]
fn blend<T: Vectors, S: Simd, const C: usize>(
    simd: S,
    weights: &[Row<T>],
    bones: &[Bone<T>],
    at: usize,
) -> [Lanes<T, S>; C] {
    let mut sums = [Lanes::zero(simd); C];
    for (weights, bone) in weights.iter().zip(bones) {
        let weight = Lanes::load(simd, &weights[at..]);
        for c in 0..C {
            sums[c] = weight.times_plus(Lanes::splat(simd, bone[c]), sums[c]);
        }
    }
    sums
}

/// The blended affine rows times a point.
#[inline(always)]
fn carry<T: Vectors, S: Simd, const C: usize>(
    blended: &[Lanes<T, S>; C],
    [x, y, z]: [Lanes<T, S>; 3],
) -> [Lanes<T, S>; 3] {
    let mut carried = [x; 3];
    for i in 0..3 {
        let along_z = blended[4 * i + 2].times_plus(z, blended[4 * i + 3]);
        carried[i] = blended[4 * i].times_plus(x, blended[4 * i + 1].times_plus(y, along_z));
    }
    carried
}

/// In the mirror of the plane x = 0.
#[inline(always)]
fn mirror_point<T: Vectors, S: Simd>([x, y, z]: [Lanes<T, S>; 3], mirrored: bool) -> [Lanes<T, S>; 3] {
    [if mirrored { -x } else { x }, y, z]
}

#[inline(always)]
fn mirror_turn<T: Vectors, S: Simd>([w, x, y, z]: Four<Lanes<T, S>>, mirrored: bool) -> Four<Lanes<T, S>> {
    if mirrored { [w, x, -y, -z] } else { [w, x, y, z] }
}

/// The factor of light on the Gaussians at `at`, and the normal and its harmonics that it is a function of.
struct Lit<T: Vectors, S: Simd> {
    factor: [Lanes<T, S>; 3],
    normal: Normal<T, S>,
    basis: [Lanes<T, S>; CLIP],
}

impl<T: Vectors, S: Simd> Lit<T, S> {
    #[inline(always)]
    fn of(
        simd: S,
        quat: Four<Lanes<T, S>>,
        clip: &[[T; 3]; CLIP],
        shade: &[T],
        parts: &[Row<T>],
        at: usize,
    ) -> Self {
        let normal = Normal::of(simd, quat);
        let basis = basis(simd, normal.axis);
        let mut shaded = Lanes::splat(simd, shade[0]);
        for i in 0..3 {
            shaded = normal.axis[i].times_plus(Lanes::splat(simd, shade[1 + i]), shaded);
        }
        for (part, &shade) in parts.iter().zip(&shade[4..]) {
            shaded = Lanes::load(simd, &part[at..]).times_plus(Lanes::splat(simd, shade), shaded);
        }
        let mut factor = [shaded; 3];
        for c in 0..3 {
            for b in 0..CLIP {
                factor[c] = basis[b].times_plus(Lanes::splat(simd, clip[b][c]), factor[c]);
            }
            factor[c] = factor[c].exp(simd);
        }
        Self {
            factor,
            normal,
            basis,
        }
    }
}

/// What one chunk becomes in every frame.
pub(crate) struct Posed<'a, T> {
    pub(crate) means: Vec<&'a mut [[T; 3]]>,
    /// Empty where only centres are wanted.
    pub(crate) quats: Vec<&'a mut [[T; 4]]>,
    /// Colours and labels, `channels` values each.
    pub(crate) colors: Vec<&'a mut [T]>,
}

pub(crate) struct Forward<'a, 'o, T> {
    pub(crate) subject: &'a Subject<'a, T>,
    pub(crate) bones: &'a Bones<T>,
    pub(crate) clip: &'a [[T; 3]; CLIP],
    pub(crate) first: usize,
    pub(crate) out: Posed<'o, T>,
    /// Of a colour: three, or more with labels.
    pub(crate) channels: usize,
    /// The label channel that is the subject's own.
    pub(crate) label: usize,
}

impl<T: Vectors> Work for Forward<'_, '_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        let (subject, first) = (self.subject, self.first);
        let len = self.out.means.first().map_or(0, |means| means.len());
        let inputs = Inputs::of(subject, self.bones.count, first, len);
        let mut at_rest = rows(points(subject, 0, first, len));
        let (mut means, mut quats, mut colors) = (
            [[T::ZERO; CHUNK]; 3],
            [[T::ZERO; CHUNK]; 4],
            [[T::ZERO; CHUNK]; 3],
        );
        let light = subject
            .surface
            .as_ref()
            .and_then(|surface| surface.light.as_ref());
        for frame in 0..self.out.means.len() {
            if subject.moves() && frame > 0 {
                at_rest = rows(points(subject, frame, first, len));
            }
            let bones = self.bones.of_frame(frame);
            for at in (0..len).step_by(Lanes::<T, S>::COUNT) {
                let rest = load(simd, &at_rest, at);
                if subject.surface.is_none() {
                    let blended = blend::<T, S, 12>(simd, &inputs.weights, bones, at);
                    store(
                        mirror_point(carry(&blended, rest), subject.mirrored),
                        &mut means,
                        at,
                    );
                    continue;
                }
                let blended = blend::<T, S, 16>(simd, &inputs.weights, bones, at);
                store(
                    mirror_point(carry(&blended, rest), subject.mirrored),
                    &mut means,
                    at,
                );
                let [.., w, x, y, z] = blended;
                let turned = product([w, x, y, z], load(simd, &inputs.quats, at));
                let turned = mirror_turn(turned, subject.mirrored);
                store(turned, &mut quats, at);
                let mut shown: [_; 3] = load(simd, &inputs.albedo, at);
                if let Some(light) = light {
                    let shade = light.of_frame(frame);
                    let lit = Lit::of(simd, turned, self.clip, shade, &inputs.parts, at);
                    for c in 0..3 {
                        shown[c] = shown[c] * lit.factor[c];
                    }
                }
                store(shown, &mut colors, at);
            }
            write(&means, self.out.means[frame]);
            if subject.surface.is_some() {
                write(&quats, self.out.quats[frame]);
                for (i, out) in self.out.colors[frame].chunks_exact_mut(self.channels).enumerate() {
                    for c in 0..3 {
                        out[c] = colors[c][i];
                    }
                    for (label, value) in out[3..].iter_mut().enumerate() {
                        *value = if label == self.label { T::ONE } else { T::ZERO };
                    }
                }
            }
        }
    }
}

/// Gradients of what a chunk became; `None` for zeros.
pub(crate) struct Pulls<'a, T> {
    pub(crate) means: Option<&'a [[T; 3]]>,
    pub(crate) quats: Option<&'a [[T; 4]]>,
    pub(crate) colors: Option<&'a [T]>,
    /// Gaussians of all subjects in a frame, and those before the chunk.
    pub(crate) total: usize,
    pub(crate) before: usize,
    pub(crate) channels: usize,
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
pub(crate) struct ChunkGradients<T> {
    /// One for each Gaussian, or for each frame and Gaussian.
    pub(crate) points: Vec<[T; 3]>,
    pub(crate) weights: Vec<T>,
    pub(crate) quats: Vec<[T; 4]>,
    pub(crate) albedo: Vec<[T; 3]>,
    pub(crate) bones: Vec<Bone<T>>,
    pub(crate) shade: Vec<T>,
    pub(crate) clip: [[T; 3]; CLIP],
}

pub(crate) struct Backward<'a, T> {
    pub(crate) subject: &'a Subject<'a, T>,
    pub(crate) bones: &'a Bones<T>,
    pub(crate) clip: &'a [[T; 3]; CLIP],
    pub(crate) first: usize,
    pub(crate) len: usize,
    pub(crate) frames: usize,
    pub(crate) pulls: Pulls<'a, T>,
    pub(crate) wanted: Wanted,
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
        };
        let mut v_points = [[T::ZERO; CHUNK]; 3];
        let mut v_weights = vec![[T::ZERO; CHUNK]; if wanted.weights { self.bones.count } else { 0 }];
        let (mut v_quats, mut v_albedo) = ([[T::ZERO; CHUNK]; 4], [[T::ZERO; CHUNK]; 3]);
        let mut v_blended = Blended {
            rows: [[T::ZERO; CHUNK]; 16],
        };
        let mut v_shaded = [T::ZERO; CHUNK];
        let mut clip_sums = [[Lanes::<T, S>::zero(simd); CLIP]; 3];
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
            };
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
                if let Some(light) = light {
                    let turned = mirror_turn(product(bone, quat), subject.mirrored);
                    let shade = light.of_frame(frame);
                    let lit = Lit::of(simd, turned, self.clip, shade, &inputs.parts, at);
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
                        v_axis[i] = shared.times_plus(Lanes::splat(simd, shade[1 + i]), v_axis[i]);
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

//! One chunk of a subject's Gaussians in rows, and what forward and backward loops over it share, in vectors of the CPU's
//! level.

use bigs_raster::{Simd, Vectors};

use crate::lanes::{Four, LONGEST, Lanes};
use crate::pose::bones::Bone;
use crate::pose::light::{CLIP, Normal, basis};
use crate::pose::{Light, Subject};

/// Gaussians of one task. Fixed, so that sums do not depend on the number of threads; whole vectors of every level.
pub(super) const CHUNK: usize = 128;
const _: () = assert!(CHUNK.is_multiple_of(LONGEST));

/// One value of each Gaussian of a chunk.
pub(super) type Row<T> = [T; CHUNK];

/// Rows of the values [first, first + len) of an array of `D` values each; zero beyond.
pub(super) fn rows<T: Vectors, const D: usize>(values: &[[T; D]]) -> [Row<T>; D] {
    let mut rows = [[T::ZERO; CHUNK]; D];
    for (i, value) in values.iter().enumerate() {
        for d in 0..D {
            rows[d][i] = value[d];
        }
    }
    rows
}

/// The same where the number of values is known at run time.
pub(super) fn some_rows<T: Vectors>(values: &[T], each: usize) -> Vec<Row<T>> {
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

pub(super) fn write<T: Vectors, const D: usize>(rows: &[Row<T>; D], out: &mut [[T; D]]) {
    for (i, value) in out.iter_mut().enumerate() {
        for d in 0..D {
            value[d] = rows[d][i];
        }
    }
}

/// Loads `D` vectors from the same place of as many rows.
#[inline(always)]
pub(super) fn load<T: Vectors, S: Simd, const D: usize>(
    simd: S,
    rows: &[Row<T>; D],
    at: usize,
) -> [Lanes<T, S>; D] {
    let mut out = [Lanes::zero(simd); D];
    for d in 0..D {
        out[d] = Lanes::load(simd, &rows[d][at..]);
    }
    out
}

#[inline(always)]
pub(super) fn store<T: Vectors, S: Simd, const D: usize>(
    values: [Lanes<T, S>; D],
    rows: &mut [Row<T>; D],
    at: usize,
) {
    for d in 0..D {
        values[d].store(&mut rows[d][at..]);
    }
}

#[inline(always)]
pub(super) fn add<T: Vectors, S: Simd, const D: usize>(
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
pub(super) struct Inputs<T> {
    pub(super) weights: Vec<Row<T>>,
    pub(super) quats: [Row<T>; 4],
    pub(super) albedo: [Row<T>; 3],
    pub(super) parts: Vec<Row<T>>,
}

impl<T: Vectors> Inputs<T> {
    pub(super) fn of(subject: &Subject<'_, T>, bones: usize, first: usize, len: usize) -> Self {
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

/// What covers the sky above a chunk in one frame; zero without ambient light.
pub(super) fn occlusion<T: Vectors>(
    subject: &Subject<'_, T>,
    frame: usize,
    first: usize,
    len: usize,
) -> Row<T> {
    let mut row = [T::ZERO; CHUNK];
    if let Some(ambient) = subject
        .surface
        .and_then(|surface| surface.light)
        .and_then(|light| light.ambient)
    {
        row[..len].copy_from_slice(&ambient.occlusion[frame * subject.count + first..][..len]);
    }
    row
}

/// The rest points of a chunk in one frame.
pub(super) fn points<'a, T>(
    subject: &Subject<'a, T>,
    frame: usize,
    first: usize,
    len: usize,
) -> &'a [[T; 3]] {
    let before = if subject.moves() { frame * subject.count } else { 0 };
    &subject.points[before + first..][..len]
}

/// Bones blended by the weights of the Gaussians at `at`.
#[inline(always)]
pub(super) fn blend<T: Vectors, S: Simd, const C: usize>(
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
pub(super) fn carry<T: Vectors, S: Simd, const C: usize>(
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
pub(super) fn mirror_point<T: Vectors, S: Simd>(
    [x, y, z]: [Lanes<T, S>; 3],
    mirrored: bool,
) -> [Lanes<T, S>; 3] {
    [if mirrored { -x } else { x }, y, z]
}

#[inline(always)]
pub(super) fn mirror_turn<T: Vectors, S: Simd>(
    [w, x, y, z]: Four<Lanes<T, S>>,
    mirrored: bool,
) -> Four<Lanes<T, S>> {
    if mirrored { [w, x, -y, -z] } else { [w, x, y, z] }
}

/// The light of one frame on a chunk.
pub(super) struct FrameLight<'a, T> {
    pub(super) clip: &'a [[T; 3]; CLIP],
    pub(super) shade: &'a [T],
    pub(super) parts: &'a [Row<T>],
    pub(super) occlusion: &'a Row<T>,
    pub(super) strength: [T; 3],
}

impl<'a, T: Vectors> FrameLight<'a, T> {
    pub(super) fn of(
        light: &Light<'a, T>,
        clip: &'a [[T; 3]; CLIP],
        frame: usize,
        parts: &'a [Row<T>],
        occlusion: &'a Row<T>,
    ) -> Self {
        Self {
            clip,
            shade: light.of_frame(frame),
            parts,
            occlusion,
            strength: light.strength(),
        }
    }
}

/// The factor of light on the Gaussians at `at`, and the normal and its harmonics that it is a function of.
pub(super) struct Lit<T: Vectors, S: Simd> {
    pub(super) factor: [Lanes<T, S>; 3],
    pub(super) normal: Normal<T, S>,
    pub(super) basis: [Lanes<T, S>; CLIP],
}

impl<T: Vectors, S: Simd> Lit<T, S> {
    #[inline(always)]
    pub(super) fn of(simd: S, quat: Four<Lanes<T, S>>, light: &FrameLight<'_, T>, at: usize) -> Self {
        let shade = light.shade;
        let normal = Normal::of(simd, quat);
        let basis = basis(simd, normal.axis);
        let mut shaded = Lanes::splat(simd, shade[0]);
        for i in 0..3 {
            shaded = normal.axis[i].times_plus(Lanes::splat(simd, shade[1 + i]), shaded);
        }
        for (part, &shade) in light.parts.iter().zip(&shade[4..]) {
            shaded = Lanes::load(simd, &part[at..]).times_plus(Lanes::splat(simd, shade), shaded);
        }
        let covered = Lanes::load(simd, &light.occlusion[at..]);
        let mut factor = [shaded; 3];
        for c in 0..3 {
            factor[c] = covered.times_plus(Lanes::splat(simd, light.strength[c]), factor[c]);
            for b in 0..CLIP {
                factor[c] = basis[b].times_plus(Lanes::splat(simd, light.clip[b][c]), factor[c]);
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

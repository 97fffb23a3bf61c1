//! What the Gaussians of one chunk become in every frame.

use bigs_raster::{Simd, Vectors, Work};

use crate::lanes::{Lanes, product};
use crate::pose::Subject;
use crate::pose::bones::Bones;
use crate::pose::chunk::{
    CHUNK, FrameLight, Inputs, Lit, blend, carry, load, mirror_point, mirror_turn, occlusion, points, rows,
    store, write,
};
use crate::pose::light::CLIP;

/// What one chunk becomes in every frame.
pub(super) struct Posed<'a, T> {
    pub(super) means: Vec<&'a mut [[T; 3]]>,
    /// Empty where only centres are wanted.
    pub(super) quats: Vec<&'a mut [[T; 4]]>,
    /// Colours and labels, `channels` values each.
    pub(super) colors: Vec<&'a mut [T]>,
}

pub(super) struct Forward<'a, 'o, T> {
    pub(super) subject: &'a Subject<'a, T>,
    pub(super) bones: &'a Bones<T>,
    pub(super) clip: &'a [[T; 3]; CLIP],
    pub(super) first: usize,
    pub(super) out: Posed<'o, T>,
    /// Of a colour: three, or more with labels.
    pub(super) channels: usize,
    /// The label channel that is the subject's own.
    pub(super) label: usize,
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
            let covered = occlusion(subject, frame, first, len);
            let light = light.map(|light| FrameLight::of(light, self.clip, frame, &inputs.parts, &covered));
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
                if let Some(light) = &light {
                    let lit = Lit::of(simd, turned, light, at);
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

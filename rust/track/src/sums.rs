//! Sums over the samples of a patch, in lanes, so that they are fast in an order of their own.

const LANES: usize = 8;

/// The sum of `term(index)` over `count` samples.
#[inline(always)]
pub(crate) fn sum<const D: usize>(count: usize, term: impl Fn(usize) -> [f32; D]) -> [f32; D] {
    let mut lanes = [[0.0f32; LANES]; D];
    let whole = count - count % LANES;
    for start in (0..whole).step_by(LANES) {
        for lane in 0..LANES {
            let terms = term(start + lane);
            for d in 0..D {
                lanes[d][lane] += terms[d];
            }
        }
    }
    for index in whole..count {
        let terms = term(index);
        for d in 0..D {
            lanes[d][index - whole] += terms[d];
        }
    }
    lanes.map(|lanes| lanes.iter().sum())
}

//! Patches as their own picture shows them.

use rayon::prelude::*;

use crate::{Picture, TrackError};

/// Samples of a patch whose pixels show less of what is tracked than this count for nothing.
const LEAST_SHOWN: f32 = 0.99;
/// Deviation of the weights about a patch's middle, as a share of half its side.
const BELL: f32 = 0.6;

/// Patches, one after the other, each row by row.
#[derive(Clone, Copy, Debug)]
pub struct Templates<'a> {
    /// Grey values.
    pub grey: &'a [f32],
    /// How they change by a pixel's step to the right, and down.
    pub slope: &'a [[f32; 2]],
    /// How much each sample counts: less towards the patch's border, nothing beside what is tracked.
    pub weight: &'a [f32],
}

/// Patches that own their values, see [`Templates`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cut {
    /// Grey values.
    pub grey: Vec<f32>,
    /// Their slopes.
    pub slope: Vec<[f32; 2]>,
    /// Their weights.
    pub weight: Vec<f32>,
}

impl Cut {
    /// The same, borrowed.
    pub fn templates(&self) -> Templates<'_> {
        Templates {
            grey: &self.grey,
            slope: &self.slope,
            weight: &self.weight,
        }
    }
}

/// Patches of `2 * half + 1` samples a side about places of a picture.
///
/// # Errors
///
/// `half` is 0.
pub fn cut(picture: &Picture<'_>, places: &[[f32; 2]], half: usize) -> Result<Cut, TrackError> {
    if half == 0 {
        return Err(TrackError::size("half", half, 1));
    }
    let side = 2 * half + 1;
    let size = side * side;
    let bell: Vec<f32> = (0..size)
        .map(|sample| {
            let [x, y] = offset(sample, half);
            (-0.5 * (x * x + y * y) / (BELL * half as f32).powi(2)).exp()
        })
        .collect();
    let count = places.len() * size;
    let mut found = Cut {
        grey: vec![0.0; count],
        slope: vec![[0.0; 2]; count],
        weight: vec![0.0; count],
    };
    (
        found.grey.par_chunks_exact_mut(size),
        found.slope.par_chunks_exact_mut(size),
        found.weight.par_chunks_exact_mut(size),
        places,
    )
        .into_par_iter()
        .for_each_init(
            || [vec![0.0; size], vec![0.0; size]],
            |[ahead, behind], (grey, slope, weight, &[x, y])| {
                picture.square(picture.grey, [x, y], half, grey);
                for (axis, [dx, dy]) in [[0.5, 0.0], [0.0, 0.5]].into_iter().enumerate() {
                    picture.square(picture.grey, [x + dx, y + dy], half, ahead);
                    picture.square(picture.grey, [x - dx, y - dy], half, behind);
                    for sample in 0..size {
                        slope[sample][axis] = ahead[sample] - behind[sample];
                    }
                }
                picture.square(picture.shown, [x, y], half, ahead);
                for sample in 0..size {
                    let [dx, dy] = offset(sample, half);
                    let counts = ahead[sample] > LEAST_SHOWN && picture.holds([x + dx, y + dy]);
                    weight[sample] = if counts { bell[sample] } else { 0.0 };
                }
            },
        );
    Ok(found)
}

/// Where a sample is, from its patch's middle.
pub(crate) fn offset(sample: usize, half: usize) -> [f32; 2] {
    let side = 2 * half + 1;
    [
        (sample % side) as f32 - half as f32,
        (sample / side) as f32 - half as f32,
    ]
}

//! Gaussians that own their arrays, and where a camera should stand to see them.
// Each example uses a part.
#![allow(dead_code)]

use bigs_raster::{Gaussians, RasterError};

/// The constant real spherical harmonic.
const SH_C0: f32 = 0.282_094_79;

/// A scene as splat files store it, with real opacities and scales.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Splats {
    pub(crate) means: Vec<[f32; 3]>,
    /// w x y z, of any length.
    pub(crate) quats: Vec<[f32; 4]>,
    /// Standard deviations.
    pub(crate) scales: Vec<[f32; 3]>,
    pub(crate) opacities: Vec<f32>,
    /// Harmonics of colour, red green blue each; (degree + 1)² per Gaussian.
    pub(crate) harmonics: Vec<[f32; 3]>,
    /// 0 to 3.
    pub(crate) degree: usize,
}

impl Splats {
    pub(crate) fn len(&self) -> usize {
        self.means.len()
    }

    /// Adds a Gaussian that has the same colour from everywhere.
    pub(crate) fn push(
        &mut self,
        mean: [f32; 3],
        quat: [f32; 4],
        scale: [f32; 3],
        opacity: f32,
        rgb: [f32; 3],
    ) {
        self.means.push(mean);
        self.quats.push(quat);
        self.scales.push(scale);
        self.opacities.push(opacity);
        self.harmonics.push(rgb.map(|v| (v - 0.5) / SH_C0));
    }

    /// What the renderer takes.
    pub(crate) fn view(&self) -> Result<Gaussians<'_, f32>, RasterError> {
        let bases = (self.degree + 1).pow(2);
        Gaussians::with_harmonics(
            &self.means,
            &self.quats,
            &self.scales,
            &self.opacities,
            self.degree,
            bases,
            self.harmonics.as_flattened(),
        )
    }

    /// Red, green and blue of a Gaussian without the part that depends on the direction of view.
    pub(crate) fn color(&self, i: usize) -> [f32; 3] {
        self.harmonics[i * (self.degree + 1).pow(2)].map(|v| v * SH_C0 + 0.5)
    }

    /// A centre and a radius that most Gaussians lie within. Medians, because captured scenes have far-off strays.
    pub(crate) fn bounds(&self) -> ([f32; 3], f32) {
        let centre = [0, 1, 2].map(|axis| quantile(self.means.iter().map(|m| m[axis]).collect(), 0.5));
        let distances = self.means.iter().map(|m| {
            let d = [0, 1, 2].map(|axis| m[axis] - centre[axis]);
            (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt()
        });
        (centre, quantile(distances.collect(), 0.9))
    }
}

/// The value that this part of the values lies below; 0 of none.
fn quantile(mut values: Vec<f32>, part: f32) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let index = ((values.len() - 1) as f32 * part) as usize;
    *values.select_nth_unstable_by(index, f32::total_cmp).1
}

//! One call of the public API with arbitrary and adversarial inputs.

use bigs_raster::{
    Batch, BatchGaussians, BatchInputs, BatchShape, Broadcast, Camera, CameraModel, Gaussians, Intrinsics,
    RasterError, RasterSettings, RenderMode, Renderer, Scalar, Wanted,
};

use super::dice::{Dice, Wildness, number, scalar};

/// Everything that one call takes.
#[derive(Clone, Debug)]
pub struct Case<T> {
    pub wildness: Wildness,
    pub shape: BatchShape,
    pub means: Vec<T>,
    pub quats: Vec<T>,
    pub scales: Vec<T>,
    pub opacities: Vec<T>,
    pub colors: Vec<T>,
    pub viewmats: Vec<T>,
    pub ks: Vec<T>,
    pub backgrounds: Option<Vec<T>>,
    pub pixel_mask: Option<Vec<bool>>,
    /// Which inputs have a part per entry: means, quats, scales, opacities, colors.
    pub per_entry: [bool; 5],
    pub v_colors: Vec<T>,
    pub v_alphas: Vec<T>,
    pub settings: RasterSettings,
    pub mode: RenderMode,
    pub model: CameraModel,
    pub wanted: Wanted,
}

const MODES: [RenderMode; 5] = [
    RenderMode::Rgb,
    RenderMode::Depth,
    RenderMode::ExpectedDepth,
    RenderMode::RgbDepth,
    RenderMode::RgbExpectedDepth,
];

fn settings(dice: &mut Dice, wildness: Wildness) -> RasterSettings {
    let mut s = RasterSettings {
        tile_size: [32, 16, 8, 4][dice.below(4)],
        antialiased: dice.once_in(4),
        exp_degree: [5, 5, 4, 3][dice.below(4)],
        ..Default::default()
    };
    let choices: [(&mut f64, [f64; 4]); 6] = [
        (&mut s.eps2d, [0.3, 0.3, 0.0, 1e-6]),
        (&mut s.near_plane, [0.01, 0.01, 1e-30, 1.0]),
        (&mut s.radius_clip, [0.0, 0.0, 0.0, 3.0]),
        (&mut s.alpha_threshold, [1.0 / 255.0, 1.0 / 255.0, 0.0, 1e-30]),
        (&mut s.max_alpha, [0.999, 0.999, 0.5, 0.999_999]),
        (&mut s.min_transmittance, [1e-4, 1e-4, 0.0, 0.5]),
    ];
    for (value, options) in choices {
        *value = options[dice.below(4)];
        if wildness == Wildness::Bits && dice.once_in(20) {
            *value = number(dice, wildness, 0.0, 1.0);
        }
    }
    if dice.once_in(20) {
        // Expected depth divides by alpha, 1e-10 at least: depths of 1e28 m would overflow f32.
        s.far_plane = if wildness == Wildness::Bits {
            f64::INFINITY
        } else {
            1e20
        };
    }
    s
}

impl<T: Scalar> Case<T> {
    /// The case of a seed.
    pub fn new(seed: u64) -> Self {
        let dice = &mut Dice::new(seed);
        let wildness = [
            Wildness::Tame,
            Wildness::Stretched,
            Wildness::Finite,
            Wildness::Finite,
            Wildness::Bits,
        ][dice.below(5)];
        let (entries, cameras) = if dice.once_in(4) {
            (1 + dice.below(3), 1 + dice.below(3))
        } else {
            (1, 1)
        };
        let gaussians = [dice.below(4), dice.below(40), dice.below(300)][dice.below(3)];
        let (width, height) = match dice.below(12) {
            0 => (1, 1),
            1 => (1 + dice.below(900), 1 + dice.below(3)),
            2 => (1 + dice.below(3), 1 + dice.below(900)),
            _ => (1 + dice.below(50), 1 + dice.below(50)),
        };
        let shape = BatchShape {
            entries,
            cameras,
            gaussians,
            channels: if dice.once_in(3) { 1 + dice.below(19) } else { 3 },
            width,
            height,
        };
        let mode = MODES[dice.below(5)];
        let mut settings = settings(dice, wildness);
        if !T::HAS_EXP_DEGREES && wildness != Wildness::Bits {
            settings.exp_degree = RasterSettings::default().exp_degree;
        }
        let per_entry = [(); 5].map(|()| dice.once_in(2));
        let rows = |own: bool| gaussians * if own { entries } else { 1 };
        let fill = |dice: &mut Dice, count: usize, low: f64, high: f64| -> Vec<T> {
            (0..count).map(|_| scalar(dice, wildness, low, high)).collect()
        };
        let mut means = fill(dice, 3 * rows(per_entry[0]), -1.0, 1.0);
        // In front of the camera, most of them; some at equal depth, some on one spot.
        for mean in means.as_chunks_mut::<3>().0 {
            mean[2] = match dice.below(12) {
                0 => T::of(2.0),
                1 => mean[2],
                _ => mean[2] + T::of(2.0),
            };
            if dice.once_in(20) {
                *mean = [T::of(0.1), T::of(0.1), T::of(1.5)];
            }
        }
        let quats = fill(dice, 4 * rows(per_entry[1]), -1.0, 1.0);
        let reach = [0.02, 0.1, 0.5, 3.0][dice.below(4)];
        let scales = fill(dice, 3 * rows(per_entry[2]), 0.0, reach);
        let opacities = fill(dice, rows(per_entry[3]), 0.0, 1.0);
        // What is summed over pixels and weighted by gradients needs room to grow.
        let painted = |values: Vec<T>| -> Vec<T> {
            let limit = T::of(1e15);
            let limited = |v: T| if v.is_finite() { v.limit(-limit, limit) } else { v };
            values.into_iter().map(limited).collect()
        };
        let colors = painted(fill(dice, shape.channels * rows(per_entry[4]), 0.0, 1.0));
        let backgrounds = dice
            .once_in(2)
            .then(|| painted(fill(dice, shape.views() * shape.channels, 0.0, 1.0)));
        let mut viewmats = Vec::new();
        let mut ks = Vec::new();
        for _ in 0..shape.views() {
            // Cameras are wild less often: a bad one hides the rest of the case.
            let own = if dice.once_in(4) { wildness } else { Wildness::Tame };
            for row in 0..4 {
                for column in 0..4 {
                    let unit = f64::from(u8::from(row == column));
                    let value = scalar(dice, own, unit - 0.1, unit + 0.1);
                    viewmats.push(if row == 3 { T::of(unit) } else { value });
                }
            }
            let focal = width.max(height) as f64;
            let f = scalar::<T>(dice, own, 0.5 * focal, 2.0 * focal);
            let fy = scalar::<T>(dice, own, 0.5 * focal, 2.0 * focal);
            let cx = scalar::<T>(dice, own, 0.3 * width as f64, 0.7 * width as f64);
            let cy = scalar::<T>(dice, own, 0.3 * height as f64, 0.7 * height as f64);
            ks.extend([f, T::ZERO, cx, T::ZERO, fy, cy, T::ZERO, T::ZERO, T::ONE]);
        }
        let pixels = shape.views() * width * height;
        let pixel_mask = dice
            .once_in(4)
            .then(|| (0..pixels).map(|_| dice.once_in(2)).collect());
        let total = shape.image_channels(mode);
        // Gradients that come in are those of a loss: ordinary numbers, many of them zero.
        let cotangent = |dice: &mut Dice| {
            T::of(if dice.once_in(2) {
                dice.uniform(-1.0, 1.0)
            } else {
                0.0
            })
        };
        let v_colors = (0..pixels * total).map(|_| cotangent(dice)).collect();
        let v_alphas = (0..pixels).map(|_| cotangent(dice)).collect();
        let mut flag = || !dice.once_in(4);
        let wanted = Wanted {
            means: flag(),
            quats: flag(),
            scales: flag(),
            opacities: flag(),
            colors: flag(),
            viewmats: flag(),
            backgrounds: flag(),
            means2d: flag(),
            detach_means2d: !flag(),
            absgrad: !flag(),
        };
        let model = if flag() {
            CameraModel::Pinhole
        } else {
            CameraModel::Orthographic
        };
        let mut case = Self {
            wildness,
            shape,
            means,
            quats,
            scales,
            opacities,
            colors,
            viewmats,
            ks,
            backgrounds,
            pixel_mask,
            per_entry,
            v_colors,
            v_alphas,
            settings,
            mode,
            model,
            wanted,
        };
        if wildness == Wildness::Bits && dice.once_in(4) {
            case.break_a_length(dice);
        }
        case
    }

    /// Sizes that do not fit each other.
    fn break_a_length(&mut self, dice: &mut Dice) {
        match dice.below(10) {
            0 => drop(self.means.pop()),
            1 => drop(self.quats.pop()),
            2 => self.scales.push(T::ONE),
            3 => drop(self.opacities.pop()),
            4 => drop(self.colors.pop()),
            5 => drop(self.viewmats.pop()),
            6 => drop(self.ks.pop()),
            7 => drop(self.v_colors.pop()),
            8 => self.shape.width = [0, usize::MAX, 1 << 40, 1 << 33][dice.below(4)],
            _ => self.shape.gaussians += 1,
        }
    }

    fn broadcast<'a, U>(&self, data: &'a [U], per_entry: bool, per_camera: bool) -> Broadcast<'a, U> {
        Broadcast {
            data,
            entries: if per_entry { self.shape.entries } else { 1 },
            cameras: if per_camera { self.shape.cameras } else { 1 },
        }
    }

    fn inputs(&self) -> BatchInputs<'_, T> {
        let of_gaussians = |data, own| self.broadcast(data, own, false);
        BatchInputs {
            gaussians: BatchGaussians {
                means: of_gaussians(&self.means, self.per_entry[0]),
                quats: of_gaussians(&self.quats, self.per_entry[1]),
                scales: of_gaussians(&self.scales, self.per_entry[2]),
                opacities: of_gaussians(&self.opacities, self.per_entry[3]),
                colors: of_gaussians(&self.colors, self.per_entry[4]),
            },
            viewmats: self.broadcast(&self.viewmats, true, true),
            ks: self.broadcast(&self.ks, true, true),
            backgrounds: self.backgrounds.as_deref().map(|b| self.broadcast(b, true, true)),
            pixel_mask: self.pixel_mask.as_deref().map(|m| self.broadcast(m, true, true)),
            camera_model: self.model,
        }
    }

    /// Image, alphas and gradients, or the error.
    pub fn render(&self) -> Result<Vec<(&'static str, Vec<T>)>, RasterError> {
        let batch = Batch::new(self.shape, self.inputs(), &self.settings, self.mode)?;
        let (images, state) = batch.render()?;
        let v = state.vjp(
            &self.inputs().gaussians,
            Some(&self.v_colors),
            Some(&self.v_alphas),
            self.wanted,
        )?;
        Ok(vec![
            ("colors", images.colors),
            ("alphas", images.alphas),
            ("means2d", images.means2d.into_flattened()),
            ("depths", images.depths),
            ("v_means", v.means),
            ("v_quats", v.quats),
            ("v_scales", v.scales),
            ("v_opacities", v.opacities),
            ("v_colors", v.colors),
            ("v_viewmats", v.viewmats),
            ("v_backgrounds", v.backgrounds),
            ("v_means2d", v.means2d),
            ("absgrad", v.absgrad),
        ])
    }

    /// The first view through the single-view API; the image and the gradient of the opacities.
    pub fn render_first(&self) -> Result<(Vec<T>, Vec<T>), RasterError> {
        let (n, channels) = (self.shape.gaussians, self.shape.channels);
        let gaussians = Gaussians::new(
            &self.means.as_chunks().0[..n],
            &self.quats.as_chunks().0[..n],
            &self.scales.as_chunks().0[..n],
            &self.opacities[..n],
            &self.colors[..n * channels],
            channels,
        )?;
        let v = self.viewmats.as_chunks::<4>().0;
        let k = Intrinsics {
            fx: self.ks[0],
            fy: self.ks[4],
            cx: self.ks[2],
            cy: self.ks[5],
        };
        let camera = Camera::new([v[0], v[1], v[2], v[3]], k, self.shape.width, self.shape.height)?
            .with_model(self.model);
        let background = self.backgrounds.as_ref().map(|b| &b[..channels]);
        let renderer = Renderer::new(&self.settings, self.mode)?;
        let frame = renderer.render(&gaussians, &camera, background)?;
        let v_colors = &self.v_colors[..frame.colors.len()];
        let v_alphas = &self.v_alphas[..frame.alphas.len()];
        let grads = frame.vjp(&gaussians, v_colors, v_alphas)?;
        Ok((frame.colors, grads.opacities))
    }
}

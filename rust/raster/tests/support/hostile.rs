//! Calls of the public API with sizes and arrays that rarely fit, for `tests/hostile.rs` and the fuzz target.
#![allow(dead_code, unreachable_pub)]

use bigs_raster::{
    Batch, BatchGaussians, BatchInputs, BatchShape, Broadcast, Camera, CameraModel, Gaussians, Harmonics,
    Intrinsics, RasterError, RasterSettings, RenderMode, Renderer, Scalar, Wanted,
};

use super::dice::{self, Dice};
use super::support::{Scene, VIEWMAT};

pub const ALL: Wanted = Wanted {
    means: true,
    quats: true,
    scales: true,
    opacities: true,
    colors: true,
    viewmats: true,
    backgrounds: true,
    means2d: true,
    detach_means2d: false,
    absgrad: true,
};

/// A batch in which everything but the cameras is shared, and what it is made of.
pub struct Shared {
    pub scene: Scene<f32>,
    pub shape: BatchShape,
    viewmats: Vec<f32>,
    ks: [f32; 9],
}

impl Shared {
    pub fn new(n: usize, channels: usize, size: usize, cameras: usize) -> Self {
        let flat = VIEWMAT.as_flattened().iter().map(|&v| v as f32);
        let f = 1.1 * size as f32;
        Self {
            scene: Scene::random(n, channels, 3),
            shape: BatchShape {
                entries: 1,
                cameras,
                gaussians: n,
                channels,
                width: size,
                height: size,
            },
            viewmats: flat.collect::<Vec<_>>().repeat(cameras),
            ks: [f, 0.0, f / 2.0, 0.0, f, f / 2.0, 0.0, 0.0, 1.0],
        }
    }

    pub fn inputs(&self) -> BatchInputs<'_, f32> {
        let one = |data| Broadcast {
            data,
            entries: 1,
            cameras: 1,
        };
        BatchInputs {
            gaussians: BatchGaussians {
                means: one(self.scene.means.as_flattened()),
                quats: one(self.scene.quats.as_flattened()),
                scales: one(self.scene.scales.as_flattened()),
                opacities: one(&self.scene.opacities),
                colors: one(&self.scene.colors),
            },
            viewmats: Broadcast {
                data: &self.viewmats,
                entries: 1,
                cameras: self.shape.cameras,
            },
            ks: one(&self.ks),
            camera_model: CameraModel::Pinhole,
            backgrounds: None,
            pixel_mask: None,
        }
    }

    pub fn batch(&self) -> Result<Batch<'_, f32>, RasterError> {
        Batch::new(
            self.shape,
            self.inputs(),
            &RasterSettings::default(),
            RenderMode::Rgb,
        )
    }
}

/// A size, most often a small one.
fn size(dice: &mut Dice) -> usize {
    match dice.below(8) {
        0 => [1 << 31, 1 << 32, 1 << 58, (1 << 63) + 3, usize::MAX][dice.below(5)],
        1 => 0,
        _ => dice.below(24),
    }
}

fn values<T: Scalar>(dice: &mut Dice, count: usize) -> Vec<T> {
    let wildness = [dice::Wildness::Tame, dice::Wildness::Finite][dice.below(2)];
    (0..count.min(2000))
        // What is summed over pixels and weighted by gradients needs room to grow.
        .map(|_| dice::scalar::<T>(dice, wildness, -1.0, 1.0).limit(T::of(-1e15), T::of(1e15)))
        .collect()
}

fn finite<T: Scalar>(name: &str, values: &[T]) -> Result<(), String> {
    match values.iter().find(|v| !v.is_finite()) {
        Some(v) => Err(format!("{name} is {v}")),
        None => Ok(()),
    }
}

const MODES: [RenderMode; 5] = [
    RenderMode::Rgb,
    RenderMode::Depth,
    RenderMode::ExpectedDepth,
    RenderMode::RgbDepth,
    RenderMode::RgbExpectedDepth,
];

/// One view with arrays whose lengths rarely fit; whether there was an image. `Err` says what is wrong with a result.
pub fn one_view<T: Scalar>(dice: &mut Dice) -> Result<bool, String> {
    let (n, channels) = (dice.below(12), if dice.once_in(3) { size(dice) } else { 3 });
    let short = |dice: &mut Dice, n: usize| if dice.once_in(24) { dice.below(n + 2) } else { n };
    let scene = Scene::<T>::random(n, channels.min(24), dice.bits());
    let colors_len = short(dice, scene.colors.len()).min(scene.colors.len());
    let Ok(gaussians) = Gaussians::new(
        &scene.means,
        &scene.quats[..short(dice, n).min(n)],
        &scene.scales,
        &scene.opacities,
        &scene.colors[..colors_len],
        channels,
    ) else {
        return Ok(false);
    };
    let (width, height) = (size(dice), size(dice));
    let k = Intrinsics {
        fx: T::of(20.0),
        fy: T::of(20.0),
        cx: T::of(10.0),
        cy: T::of(10.0),
    };
    let Ok(camera) = Camera::new(VIEWMAT.map(|row| row.map(T::of)), k, width, height) else {
        return Ok(false);
    };
    let settings = RasterSettings {
        tile_size: [4, 8, 16, 32, 5, 0][dice.below(6)],
        max_alpha: [0.999, 1.0, 1.0 - 1e-9, 1e-300][dice.below(4)],
        alpha_threshold: [1.0 / 255.0, 0.0, 1.0 - 1e-9][dice.below(3)],
        min_transmittance: [1e-4, 0.0, 1.0 - 1e-9][dice.below(3)],
        eps2d: [0.3, 0.0, 1e300][dice.below(3)],
        ..Default::default()
    };
    let mode = MODES[dice.below(5)];
    let Ok(mut renderer) = Renderer::<T>::new(&settings, mode) else {
        return Ok(false);
    };
    if dice.once_in(2) {
        renderer = renderer.with_absgrad();
    }
    let background_len = if dice.once_in(4) { size(dice) } else { channels };
    let background = dice.once_in(2).then(|| values::<T>(dice, background_len));
    let Ok(mut frame) = renderer.render(&gaussians, &camera, background.as_deref()) else {
        return Ok(false);
    };
    finite("colors", &frame.colors)?;
    finite("alphas", &frame.alphas)?;
    let (colors_len, alphas_len) = (frame.colors.len(), frame.alphas.len());
    if dice.once_in(4) {
        frame.colors.clear();
        frame.radii.clear();
    }
    let _ = frame.median_ids();
    let other = Scene::<T>::random(dice.below(12), 1 + dice.below(4), dice.bits());
    let asked = if dice.once_in(3) { other.view() } else { gaussians };
    let v_colors: Vec<T> = (0..short(dice, colors_len))
        .map(|i| T::of((i % 5) as f64 - 2.0))
        .collect();
    let v_alphas = vec![T::ONE; short(dice, alphas_len)];
    if let Ok(v) = frame.vjp(&asked, &v_colors, &v_alphas) {
        finite("means", v.means.as_flattened())?;
        finite("quats", v.quats.as_flattened())?;
        finite("opacities", &v.opacities)?;
        finite("background", &v.background)?;
        finite("viewmat", v.viewmat.as_flattened())?;
    }
    Ok(true)
}

/// A batch whose sizes and parts rarely fit; whether there were images.
pub fn many_views(dice: &mut Dice) -> Result<bool, String> {
    let own = Shared::new(
        dice.below(8),
        1 + dice.below(4),
        1 + dice.below(20),
        1 + dice.below(3),
    );
    let mut shape = own.shape;
    let field = [
        &mut shape.entries,
        &mut shape.cameras,
        &mut shape.gaussians,
        &mut shape.channels,
        &mut shape.width,
        &mut shape.height,
    ];
    if dice.once_in(3) {
        let which = dice.below(6);
        *field.into_iter().nth(which).unwrap() = size(dice);
    }
    let mut inputs = own.inputs();
    if dice.once_in(4) {
        inputs.gaussians.means.entries = size(dice);
        inputs.ks.cameras = size(dice);
    }
    let masked: Vec<bool> = (0..size(dice).min(4000)).map(|_| dice.once_in(2)).collect();
    if dice.once_in(3) {
        inputs.pixel_mask = Some(Broadcast {
            data: &masked,
            entries: size(dice),
            cameras: 1,
        });
    }
    let background: Vec<f32> = values(dice, own.shape.channels);
    if dice.once_in(2) {
        inputs.backgrounds = Some(Broadcast {
            data: &background,
            entries: 1,
            cameras: 1,
        });
    }
    let settings = RasterSettings {
        tile_size: [4, 8, 16, 32][dice.below(4)],
        ..Default::default()
    };
    let Ok(batch) = Batch::new(shape, inputs, &settings, MODES[dice.below(5)]) else {
        return Ok(false);
    };
    let Ok((images, state)) = batch.render() else {
        return Ok(false);
    };
    finite("colors", &images.colors)?;
    state.counters();
    state.median_ids();
    let other = Shared::new(dice.below(8), 1 + dice.below(4), 5, 1);
    let asked = if dice.once_in(3) { other.inputs() } else { inputs };
    let count = size(dice);
    let v_colors: Vec<f32> = values(dice, count);
    let given = dice.once_in(3).then_some(&v_colors[..]);
    if let Ok(v) = state.vjp(&asked.gaussians, given, None, ALL) {
        finite("means", &v.means)?;
        finite("viewmats", &v.viewmats)?;
        finite("backgrounds", &v.backgrounds)?;
    }
    Ok(true)
}

/// Spherical harmonics whose counts rarely fit.
pub fn harmonics(dice: &mut Dice) -> Result<bool, String> {
    let (degree, bases) = (size(dice), [size(dice), 16, 4, 1][dice.below(4)]);
    let n = dice.below(5);
    let coefficients: Vec<f32> = values(dice, 3 * bases.min(20) * n);
    let dirs = vec![[0.5f32, -0.1, 0.3]; dice.below(12)];
    let mask = vec![true; dice.below(12)];
    let mask = dice.once_in(3).then_some(&mask[..]);
    let Ok(harmonics) = Harmonics::new(degree, bases, &dirs, &coefficients, mask) else {
        return Ok(false);
    };
    let _ = harmonics.evaluate();
    let v = vec![[1.0f32; 3]; dice.below(12)];
    let _ = harmonics.vjp(&v, dice.once_in(2), dice.once_in(2));
    Ok(true)
}

//! Fits Gaussians to a picture by gradient descent: `cargo run --release --example fit_image -- photo.png`.
//!
//! The whole loop of a differentiable renderer in one file: activations, render, loss, `Frame::vjp`, Adam. Without a
//! file it fits a built-in picture. `--help` lists the options.

#[path = "support/photo.rs"]
mod photo;
#[path = "support/picture.rs"]
mod picture;
#[path = "support/ply.rs"]
mod ply;
#[path = "support/splats.rs"]
mod splats;

use std::error::Error;
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use bigs_raster::{Camera, Gaussians, Intrinsics, RasterSettings, RenderMode, Renderer};
use fastrand::Rng;
use lexopt::prelude::*;

use picture::Picture;
use splats::Splats;

const HELP: &str = "\
Fits Gaussians to a picture.

Usage: fit_image [picture.png] [options]

  picture.png      what to fit; without it a built-in picture
  --out PATH       the result, fit.png by default
  --save-ply PATH  also write the Gaussians, for `render` and other viewers
  --start PLY      begin with the Gaussians of a file, as --save-ply wrote it, instead of random ones
  --gaussians N    3000 by default
  --steps N        500 by default
  --seed N         of the initial places, 0 by default; the same seed gives the same bits
  --side N         larger pictures are shrunk by a whole number until both sides are at most this, 384 by default
";

#[derive(Clone, Debug)]
struct Options {
    picture: Option<PathBuf>,
    out: PathBuf,
    save_ply: Option<PathBuf>,
    start: Option<PathBuf>,
    gaussians: usize,
    steps: usize,
    seed: u64,
    side: usize,
}

impl Options {
    /// `None` if only help was asked for.
    fn parse(mut parser: lexopt::Parser) -> Result<Option<Self>, lexopt::Error> {
        let mut options = Self {
            picture: None,
            out: "fit.png".into(),
            save_ply: None,
            start: None,
            gaussians: 3000,
            steps: 500,
            seed: 0,
            side: 384,
        };
        while let Some(argument) = parser.next()? {
            match argument {
                Long("out") | Short('o') => options.out = parser.value()?.into(),
                Long("save-ply") => options.save_ply = Some(parser.value()?.into()),
                Long("start") => options.start = Some(parser.value()?.into()),
                Long("gaussians") => options.gaussians = parser.value()?.parse()?,
                Long("steps") => options.steps = parser.value()?.parse()?,
                Long("seed") => options.seed = parser.value()?.parse()?,
                Long("side") => options.side = parser.value()?.parse()?,
                Long("help") | Short('h') => return Ok(None),
                Value(path) if options.picture.is_none() => options.picture = Some(path.into()),
                _ => return Err(argument.unexpected()),
            }
        }
        if options.gaussians == 0 || options.side == 0 {
            return Err("--gaussians and --side: expected numbers above 0".into());
        }
        Ok(Some(options))
    }
}

/// Hills under a low sun: smooth gradients, sharp edges, and fine stripes.
pub(crate) fn hills(width: usize, height: usize) -> Picture {
    let mut rgb = Vec::with_capacity(width * height * 3);
    for row in 0..height {
        for column in 0..width {
            let (x, y) = (column as f32 / width as f32, row as f32 / height as f32);
            let sun = ((x - 0.68).powi(2) + (y - 0.36).powi(2)).sqrt();
            let glow = (-6.0 * sun).exp();
            let mut color = [0.35 + 0.6 * y + glow, 0.3 + 0.3 * y + 0.6 * glow, 0.55 - 0.1 * y];
            if sun < 0.07 {
                color = [1.0, 0.93, 0.7];
            }
            for (layer, edge) in [0.58, 0.7, 0.84].into_iter().enumerate() {
                let k = layer as f32;
                let ridge =
                    edge + 0.05 * ((5.0 + 3.0 * k) * x + 2.0 * k).sin() + 0.02 * ((17.0 + 5.0 * k) * x).sin();
                if y > ridge {
                    let furrow = 0.06 * (90.0 * (y - ridge) + 25.0 * x).sin();
                    let dark = 1.0 - 0.28 * k;
                    color = [0.42 * dark + furrow, 0.38 * dark + furrow, 0.45 * dark];
                }
            }
            rgb.extend(color.map(|v: f32| v.clamp(0.0, 1.0)));
        }
    }
    Picture { width, height, rgb }
}

/// Adam on one array.
struct Adam {
    rate: f32,
    mean: Vec<f32>,
    square: Vec<f32>,
}

impl Adam {
    fn new(rate: f32, size: usize) -> Self {
        Self {
            rate,
            mean: vec![0.0; size],
            square: vec![0.0; size],
        }
    }

    /// `step` counts from 1; `decay` scales the learning rate.
    fn step(&mut self, values: &mut [f32], gradients: &[f32], step: i32, decay: f32) {
        const BETAS: [f32; 2] = [0.9, 0.99];
        let rate = self.rate * decay / (1.0 - BETAS[0].powi(step));
        let unbias = 1.0 / (1.0 - BETAS[1].powi(step));
        for (((value, &g), mean), square) in values
            .iter_mut()
            .zip(gradients)
            .zip(&mut self.mean)
            .zip(&mut self.square)
        {
            *mean += (1.0 - BETAS[0]) * (g - *mean);
            *square += (1.0 - BETAS[1]) * (g * g - *square);
            *value -= rate * *mean / ((*square * unbias).sqrt() + 1e-12);
        }
    }
}

/// What is optimised: numbers without bounds, from which the Gaussians are made.
struct Parameters {
    means: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    log_scales: Vec<[f32; 3]>,
    logit_opacities: Vec<f32>,
    colors: Vec<f32>,
}

impl Parameters {
    /// Gaussians at random places a little behind one another, as wide as their share of the picture and with the
    /// colour that they cover. The camera is the one of [`fit`]: one unit of the plane z = 1 is as wide as the picture.
    fn random(target: &Picture, count: usize, rng: &mut Rng) -> Self {
        let aspect = target.height as f32 / target.width as f32;
        let spacing = (aspect / count as f32).sqrt();
        let mut parameters = Self {
            means: Vec::with_capacity(count),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            log_scales: vec![[(0.5 * spacing).ln(); 3]; count],
            logit_opacities: vec![0.5; count],
            colors: Vec::with_capacity(3 * count),
        };
        for _ in 0..count {
            let (u, v) = (rng.f32(), rng.f32());
            let depth = 1.0 + 0.1 * rng.f32();
            parameters
                .means
                .push([(u - 0.5) * depth, (v - 0.5) * aspect * depth, depth]);
            let column = (u * target.width as f32) as usize;
            let row = (v * target.height as f32) as usize;
            let pixel = row.min(target.height - 1) * target.width + column.min(target.width - 1);
            parameters.colors.extend(&target.rgb[3 * pixel..3 * pixel + 3]);
        }
        parameters
    }

    fn of(splats: &Splats) -> Self {
        Self {
            means: splats.means.clone(),
            quats: splats.quats.clone(),
            log_scales: splats.scales.iter().map(|s| s.map(f32::ln)).collect(),
            logit_opacities: splats.opacities.iter().map(|o| (o / (1.0 - o)).ln()).collect(),
            colors: (0..splats.len()).flat_map(|i| splats.color(i)).collect(),
        }
    }

    fn splats(&self) -> Splats {
        let mut splats = Splats::default();
        for (i, &mean) in self.means.iter().enumerate() {
            let color = [0, 1, 2].map(|c| self.colors[3 * i + c]);
            let opacity = 1.0 / (1.0 + (-self.logit_opacities[i]).exp());
            splats.push(
                mean,
                self.quats[i],
                self.log_scales[i].map(f32::exp),
                opacity,
                color,
            );
        }
        splats
    }
}

fn psnr(mean_square: f64) -> f64 {
    -10.0 * mean_square.log10()
}

/// The fitted picture and its Gaussians.
fn fit(target: &Picture, options: &Options) -> Result<(Picture, Splats), Box<dyn Error>> {
    let (width, height) = (target.width, target.height);
    let mut p = match &options.start {
        Some(path) => Parameters::of(&ply::read(path)?),
        None => Parameters::random(target, options.gaussians, &mut Rng::with_seed(options.seed)),
    };
    let n = p.means.len();
    let focal = width as f32;
    let k = Intrinsics {
        fx: focal,
        fy: focal,
        cx: width as f32 / 2.0,
        cy: height as f32 / 2.0,
    };
    let identity = std::array::from_fn(|i| std::array::from_fn(|j| f32::from(u8::from(i == j))));
    let camera = Camera::new(identity, k, width, height)?;
    let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb)?;

    let mut of_means = Adam::new(0.3 / focal, 3 * n);
    let mut of_quats = Adam::new(0.02, 4 * n);
    let mut of_scales = Adam::new(0.03, 3 * n);
    let mut of_opacities = Adam::new(0.05, n);
    let mut of_colors = Adam::new(0.02, 3 * n);
    let mut v_colors = vec![0.0f32; target.rgb.len()];
    let v_alphas = vec![0.0f32; width * height];
    let start = Instant::now();
    for step in 0.. {
        // Scales and opacities as the renderer takes them.
        let scales: Vec<[f32; 3]> = p.log_scales.iter().map(|s| s.map(f32::exp)).collect();
        let opacities: Vec<f32> = p
            .logit_opacities
            .iter()
            .map(|x| 1.0 / (1.0 + (-x).exp()))
            .collect();
        let gaussians = Gaussians::new(&p.means, &p.quats, &scales, &opacities, &p.colors, 3)?;
        let frame = renderer.render(&gaussians, &camera, None)?;

        // The loss is the sum of squared differences: its gradient on the picture is twice the difference.
        let mut squares = 0.0;
        for ((v, &got), &wanted) in v_colors.iter_mut().zip(&frame.colors).zip(&target.rgb) {
            let difference = got - wanted;
            *v = 2.0 * difference;
            squares += f64::from(difference * difference);
        }
        let quality = psnr(squares / target.rgb.len() as f64);
        if step % 50 == 0 || step == options.steps {
            println!(
                "step {step:4}  PSNR {quality:5.2} dB  {:5.2} s",
                start.elapsed().as_secs_f64()
            );
        }
        if step == options.steps {
            let rgb = frame.colors;
            return Ok((Picture { width, height, rgb }, p.splats()));
        }

        let mut v = frame.vjp(&gaussians, &v_colors, &v_alphas)?;
        // From what the renderer takes to what is optimised.
        for (v, s) in v.scales.as_flattened_mut().iter_mut().zip(scales.as_flattened()) {
            *v *= s;
        }
        for (v, o) in v.opacities.iter_mut().zip(&opacities) {
            *v *= o * (1.0 - o);
        }
        let count = step as i32 + 1;
        let decay = 0.1f32.powf(step as f32 / options.steps as f32);
        of_means.step(p.means.as_flattened_mut(), v.means.as_flattened(), count, decay);
        of_quats.step(p.quats.as_flattened_mut(), v.quats.as_flattened(), count, decay);
        of_scales.step(
            p.log_scales.as_flattened_mut(),
            v.scales.as_flattened(),
            count,
            decay,
        );
        of_opacities.step(&mut p.logit_opacities, &v.opacities, count, decay);
        of_colors.step(&mut p.colors, &v.colors, count, decay);
    }
    unreachable!("the last step returns");
}

/// The whole program; `arguments` without the program's own name.
pub(crate) fn run<I>(arguments: I) -> Result<(), Box<dyn Error>>
where
    I: IntoIterator<Item: Into<OsString>, IntoIter: 'static>,
{
    let Some(options) = Options::parse(lexopt::Parser::from_args(arguments))? else {
        print!("{HELP}");
        return Ok(());
    };
    let target = match &options.picture {
        Some(path) => photo::read(path)?,
        None => hills(options.side.min(384), options.side.min(384) * 2 / 3),
    };
    let (longer, shorter) = (target.width.max(target.height), target.width.min(target.height));
    let target = photo::shrunk(&target, longer.div_ceil(options.side).min(shorter));
    println!("{}x{} pixels", target.width, target.height);
    let (fitted, splats) = fit(&target, &options)?;
    picture::write(&options.out, &fitted)?;
    if let Some(path) = &options.save_ply {
        ply::write(path, &splats)?;
    }
    println!("{}", options.out.display());
    Ok(())
}

fn main() -> ExitCode {
    match run(std::env::args_os().skip(1)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

//! Splats in, PNG out, without Python: `cargo run --release --example render -- scene.ply --out scene.png`.
//!
//! Reads the PLY file of 3D Gaussian splatting, looks at the middle of the scene from around it and writes a picture,
//! or a turntable with `--frames`. Without a file it shows a built-in scene. `--help` lists the options.

#[path = "support/knot.rs"]
mod knot;
#[path = "support/orbit.rs"]
mod orbit;
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
use std::time::{Duration, Instant};

use bigs_raster::{CameraModel, RasterSettings, RenderMode, Renderer};
use lexopt::prelude::*;

use orbit::{Axis, Orbit};
use picture::Picture;
use splats::Splats;

const HELP: &str = "\
Renders a scene of Gaussians.

Usage: render [scene.ply] [options]

  scene.ply             a file of 3D Gaussian splatting; without it a built-in scene is shown
  --out PATH            splats.png by default; with --frames and no extension, a folder of numbered PNGs
  --frames N            a turntable of N pictures (animated PNG, or a folder of them)
  --fps N               pictures per second of the animation, 25 by default
  --size WxH            in pixels, 640x480 by default
  --fov DEGREES         vertical field of view, 45 by default
  --up AXIS             x, y, z, -x, -y or -z; -y by default, as in most captured scenes
  --azimuth DEGREES     where the camera stands about the up axis, 60 by default
  --elevation DEGREES   and above the plane across it, 25 by default
  --zoom FACTOR         nearer than the distance that shows nearly all Gaussians, 1 by default
  --centre X,Y,Z        what to look at; the middle of the scene by default
  --background R,G,B    from 0 to 1, or one number for grey; 1 by default
  --orthographic        no perspective
  --antialiased         compensate thin Gaussians for what the pixel grid adds to them
  --save-ply PATH       also write the scene as a PLY file
  --detail FACTOR       of the built-in scene; 1 by default, fifty thousand Gaussians
";

#[derive(Clone, Debug)]
struct Options {
    scene: Option<PathBuf>,
    out: PathBuf,
    frames: usize,
    fps: u16,
    size: (usize, usize),
    fov: f32,
    up: Axis,
    azimuth: f32,
    elevation: f32,
    zoom: f32,
    centre: Option<[f32; 3]>,
    background: [f32; 3],
    model: CameraModel,
    antialiased: bool,
    save_ply: Option<PathBuf>,
    detail: f32,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            scene: None,
            out: "splats.png".into(),
            frames: 1,
            fps: 25,
            size: (640, 480),
            fov: 45.0,
            up: Axis { index: 1, sign: -1.0 },
            azimuth: 60.0,
            elevation: 25.0,
            zoom: 1.0,
            centre: None,
            background: [1.0; 3],
            model: CameraModel::Pinhole,
            antialiased: false,
            save_ply: None,
            detail: 1.0,
        }
    }
}

/// Three numbers with commas between them, or one for all three.
fn triple(text: &str) -> Result<[f32; 3], String> {
    let values: Vec<f32> = text
        .split(',')
        .map(|part| {
            part.trim()
                .parse()
                .map_err(|_| format!("expected numbers, found `{part}`"))
        })
        .collect::<Result<_, _>>()?;
    match values[..] {
        [grey] => Ok([grey; 3]),
        [x, y, z] => Ok([x, y, z]),
        _ => Err(format!("expected one or three numbers, found {}", values.len())),
    }
}

fn size(text: &str) -> Result<(usize, usize), String> {
    text.split_once('x')
        .and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)))
        .filter(|&(width, height)| (1..=1 << 14).contains(&width) && (1..=1 << 14).contains(&height))
        .ok_or_else(|| format!("expected a size like 640x480, found `{text}`"))
}

impl Options {
    /// `None` if only help was asked for.
    fn parse(mut parser: lexopt::Parser) -> Result<Option<Self>, lexopt::Error> {
        let mut options = Self::default();
        while let Some(argument) = parser.next()? {
            match argument {
                Long("out") | Short('o') => options.out = parser.value()?.into(),
                Long("frames") => options.frames = parser.value()?.parse()?,
                Long("fps") => options.fps = parser.value()?.parse()?,
                Long("size") => options.size = parser.value()?.parse_with(size)?,
                Long("fov") => options.fov = parser.value()?.parse()?,
                Long("up") => {
                    options.up = parser
                        .value()?
                        .parse_with(|text| Axis::parse(text).ok_or("expected x, y, z, -x, -y or -z"))?;
                }
                Long("azimuth") => options.azimuth = parser.value()?.parse()?,
                Long("elevation") => options.elevation = parser.value()?.parse()?,
                Long("zoom") => options.zoom = parser.value()?.parse()?,
                Long("centre" | "center") => options.centre = Some(parser.value()?.parse_with(triple)?),
                Long("background") => options.background = parser.value()?.parse_with(triple)?,
                Long("orthographic") => options.model = CameraModel::Orthographic,
                Long("antialiased") => options.antialiased = true,
                Long("save-ply") => options.save_ply = Some(parser.value()?.into()),
                Long("detail") => options.detail = parser.value()?.parse()?,
                Long("help") | Short('h') => return Ok(None),
                Value(path) if options.scene.is_none() => options.scene = Some(path.into()),
                _ => return Err(argument.unexpected()),
            }
        }
        if !(options.fov > 0.0 && options.fov < 180.0) {
            return Err("--fov: expected degrees between 0 and 180".into());
        }
        if !(options.zoom > 0.0) || options.frames == 0 || options.fps == 0 || !(options.detail > 0.0) {
            return Err("--zoom, --frames, --fps and --detail: expected numbers above 0".into());
        }
        Ok(Some(options))
    }

    /// A camera that has a scene in view.
    fn orbit(&self, splats: &Splats) -> Orbit {
        let (middle, radius) = splats.bounds();
        let (width, height) = (self.size.0 as f32, self.size.1 as f32);
        let half_angle = (self.fov.to_radians() / 2.0).tan() * (width / height).min(1.0);
        // A little more than touches the border; a scene that is one point is seen from 1 away.
        let distance = 1.25 * radius / half_angle.atan().sin() / self.zoom;
        Orbit {
            centre: self.centre.unwrap_or(middle),
            distance: if distance > 0.0 { distance } else { 1.0 },
            azimuth: self.azimuth,
            elevation: self.elevation,
            up: self.up,
        }
    }
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
    let splats = match &options.scene {
        Some(path) => ply::read(path)?,
        None => knot::scene(options.detail),
    };
    println!(
        "{} Gaussians, harmonics of degree {}",
        splats.len(),
        splats.degree
    );
    if let Some(path) = &options.save_ply {
        ply::write(path, &splats)?;
    }

    let settings = RasterSettings {
        antialiased: options.antialiased,
        ..RasterSettings::default()
    };
    let renderer = Renderer::new(&settings, RenderMode::Rgb)?;
    let orbit = options.orbit(&splats);
    let (width, height) = options.size;
    let mut rendering = Duration::ZERO;
    let mut picture = |frame: usize| -> Result<Picture, String> {
        let start = Instant::now();
        let orbit = Orbit {
            azimuth: orbit.azimuth + 360.0 * frame as f32 / options.frames as f32,
            ..orbit
        };
        let gaussians = splats.view().map_err(|e| e.to_string())?;
        let camera = orbit
            .camera(options.model, options.fov, width, height)
            .map_err(|e| e.to_string())?;
        let image = renderer
            .render(&gaussians, &camera, Some(&options.background))
            .map_err(|e| e.to_string())?;
        rendering += start.elapsed();
        Ok(Picture {
            width,
            height,
            rgb: image.colors,
        })
    };

    let out = &options.out;
    if options.frames > 1 && out.extension().is_none() {
        std::fs::create_dir_all(out)?;
        for frame in 0..options.frames {
            picture::write(&out.join(format!("{frame:04}.png")), &picture(frame)?)?;
        }
    } else {
        picture::write_animation(out, width, height, options.frames, options.fps, picture)?;
    }
    let milliseconds = 1e3 * rendering.as_secs_f64() / options.frames as f64;
    println!(
        "{}: {width}x{height}, {milliseconds:.1} ms a picture",
        out.display()
    );
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

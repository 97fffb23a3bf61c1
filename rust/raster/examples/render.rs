//! Splats in, PNG out, without Python: `cargo run --release --example render -- splats.png`.
//!
//! The splats are a torus of little discs; replace `torus` by whatever reads yours.

use std::error::Error;
use std::f32::consts::TAU;
use std::fs::File;
use std::io::BufWriter;

use bigs_raster::{Camera, Gaussians, Intrinsics, RasterSettings, RenderMode, Renderer};

const WIDTH: usize = 640;
const HEIGHT: usize = 480;

#[derive(Default)]
struct Splats {
    means: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    opacities: Vec<f32>,
    colors: Vec<f32>,
}

/// Discs that lie on a torus of radii 1 and 0.4, coloured by angle.
fn torus(around: usize, across: usize) -> Splats {
    let mut splats = Splats::default();
    for i in 0..around {
        let u = i as f32 / around as f32 * TAU;
        for j in 0..across {
            let v = j as f32 / across as f32 * TAU;
            let ring = 1.0 + 0.4 * v.cos();
            splats.means.push([ring * u.cos(), ring * u.sin(), 0.4 * v.sin()]);
            // The disc's axis z onto the normal: first about y by ½π − v, then about z by u.
            let (half_tilt, half_turn) = ((TAU / 4.0 - v) / 2.0, u / 2.0);
            let ((st, ct), (su, cu)) = (half_tilt.sin_cos(), half_turn.sin_cos());
            splats.quats.push([cu * ct, -su * st, cu * st, su * ct]);
            splats.scales.push([0.02, 0.02, 0.002]);
            splats.opacities.push(0.95);
            let shade = 0.6 + 0.4 * v.sin();
            splats
                .colors
                .extend([0.0, 1.0, 2.0].map(|c| shade * (0.5 + 0.5 * (u + c * TAU / 3.0).cos())));
        }
    }
    splats
}

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args().nth(1).unwrap_or_else(|| "splats.png".into());
    let s = torus(300, 120);
    let gaussians = Gaussians::new(&s.means, &s.quats, &s.scales, &s.opacities, &s.colors, 3)?;
    // From above: turned by 130° about x, 4 away.
    let (sin, cos) = 130f32.to_radians().sin_cos();
    let viewmat = [
        [1.0, 0.0, 0.0, 0.0],
        [0.0, cos, -sin, 0.0],
        [0.0, sin, cos, 4.0],
        [0.0, 0.0, 0.0, 1.0],
    ];
    let k = Intrinsics {
        fx: 600.0,
        fy: 600.0,
        cx: WIDTH as f32 / 2.0,
        cy: HEIGHT as f32 / 2.0,
    };
    let camera = Camera::new(viewmat, k, WIDTH, HEIGHT)?;

    let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb)?;
    let frame = renderer.render(&gaussians, &camera, Some(&[1.0, 1.0, 1.0]))?;

    let pixels: Vec<u8> = frame
        .colors
        .iter()
        .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
        .collect();
    let mut encoder = png::Encoder::new(BufWriter::new(File::create(&path)?), WIDTH as u32, HEIGHT as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header()?.write_image_data(&pixels)?;
    println!("{path}: {} splats, {WIDTH}×{HEIGHT} pixels", gaussians.len());
    Ok(())
}

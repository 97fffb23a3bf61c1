//! A small picture that must not change. `BIGS_REGENERATE=1` writes it anew; a failure leaves `*.difference.png`.

mod support;

use std::fs::File;
use std::path::{Path, PathBuf};

use bigs_raster::{RasterSettings, RenderMode, Renderer};
use support::{Scene, VIEWMAT, camera};

const SIZE: usize = 32;
/// Of 255: f32 rounding and the order of its sums may move a value over the edge between two levels.
const TOLERANCE: u8 = 1;

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/golden")
        .join(name)
}

fn write(path: &Path, pixels: &[u8]) {
    let mut encoder = png::Encoder::new(File::create(path).unwrap(), SIZE as u32, SIZE as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(pixels).unwrap();
}

fn read(path: &Path) -> Vec<u8> {
    let source = std::io::BufReader::new(File::open(path).unwrap());
    let mut reader = png::Decoder::new(source).read_info().unwrap();
    let mut pixels = vec![0; SIZE * SIZE * 3];
    reader.next_frame(&mut pixels).unwrap();
    pixels
}

#[test]
fn sixty_splats() {
    let scene = Scene::<f32>::random(60, 3, 5);
    let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb).unwrap();
    let frame = renderer
        .render(
            &scene.view(),
            &camera(VIEWMAT, SIZE, SIZE),
            Some(&[0.1, 0.1, 0.2]),
        )
        .unwrap();
    let pixels: Vec<u8> = frame
        .colors
        .iter()
        .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
        .collect();
    let golden = file("sixty_splats.png");
    if std::env::var_os("BIGS_REGENERATE").is_some() {
        write(&golden, &pixels);
    }
    let difference: Vec<u8> = read(&golden)
        .iter()
        .zip(&pixels)
        .map(|(a, b)| a.abs_diff(*b))
        .collect();
    if difference.iter().any(|&d| d > TOLERANCE) {
        let amplified: Vec<u8> = difference.iter().map(|d| d.saturating_mul(16)).collect();
        write(&file("sixty_splats.difference.png"), &amplified);
        panic!("the picture changed: see tests/golden/sixty_splats.difference.png");
    }
}

//! Pictures as 8-bit PNG, one after the other or moving.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use png::{BitDepth, ColorType, Encoder};

/// Rows, columns, red green blue, each from 0 to 1.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Picture {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) rgb: Vec<f32>,
}

impl Picture {
    /// Values outside the range are limited to it.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        self.rgb
            .iter()
            .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
            .collect()
    }
}

/// Writes a PNG.
pub(crate) fn write(path: &Path, picture: &Picture) -> Result<(), String> {
    write_animation(path, picture.width, picture.height, 1, 0, |_| Ok(picture.clone()))
}

/// Writes an animated PNG that repeats for ever, or a still one of one frame, asking for one picture at a time.
pub(crate) fn write_animation(
    path: &Path,
    width: usize,
    height: usize,
    frames: usize,
    frames_per_second: u16,
    mut frame: impl FnMut(usize) -> Result<Picture, String>,
) -> Result<(), String> {
    let fail = |e: &dyn std::fmt::Display| format!("{}: {e}", path.display());
    let file = File::create(path).map_err(|e| fail(&e))?;
    let mut encoder = Encoder::new(BufWriter::new(file), width as u32, height as u32);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    if frames > 1 {
        encoder
            .set_animated(frames as u32, 0)
            .and_then(|()| encoder.set_frame_delay(1, frames_per_second))
            .map_err(|e| fail(&e))?;
    }
    let mut writer = encoder.write_header().map_err(|e| fail(&e))?;
    for index in 0..frames {
        writer
            .write_image_data(&frame(index)?.bytes())
            .map_err(|e| fail(&e))?;
    }
    writer.finish().map_err(|e| fail(&e))
}

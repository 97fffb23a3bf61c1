//! Pictures that somebody brings.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use png::{Decoder, Transformations};

use super::picture::Picture;

/// Reads any PNG; transparency is seen over black.
pub(crate) fn read(path: &Path) -> Result<Picture, String> {
    let name = path.display();
    let file = File::open(path).map_err(|e| format!("{name}: {e}"))?;
    let mut decoder = Decoder::new(BufReader::new(file));
    decoder.set_transformations(Transformations::normalize_to_color8());
    let mut reader = decoder
        .read_info()
        .map_err(|e| format!("{name}: expected a PNG: {e}"))?;
    let size = reader
        .output_buffer_size()
        .ok_or_else(|| format!("{name}: expected a picture that fits into memory"))?;
    let mut bytes = vec![0; size];
    let info = reader
        .next_frame(&mut bytes)
        .map_err(|e| format!("{name}: {e}"))?;
    let channels = info.color_type.samples();
    let mut rgb = Vec::with_capacity(info.width as usize * info.height as usize * 3);
    for pixel in bytes[..info.buffer_size()].chunks_exact(channels) {
        let value = |i: usize| f32::from(pixel[i]) / 255.0;
        rgb.extend(match channels {
            1 => [value(0); 3],
            2 => [value(0) * value(1); 3],
            3 => [value(0), value(1), value(2)],
            _ => [0, 1, 2].map(|i| value(i) * value(3)),
        });
    }
    Ok(Picture {
        width: info.width as usize,
        height: info.height as usize,
        rgb,
    })
}

/// The mean of squares of this size; what does not fill a square at the right or lower border is dropped.
pub(crate) fn shrunk(picture: &Picture, factor: usize) -> Picture {
    let (width, height) = (picture.width / factor, picture.height / factor);
    let mut rgb = vec![0.0; width * height * 3];
    for y in 0..height * factor {
        for x in 0..width * factor {
            for c in 0..3 {
                rgb[(y / factor * width + x / factor) * 3 + c] +=
                    picture.rgb[(y * picture.width + x) * 3 + c] / (factor * factor) as f32;
            }
        }
    }
    Picture { width, height, rgb }
}

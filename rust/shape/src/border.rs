use rayon::prelude::*;

use crate::ShapeError;

/// Rows of a mask that are measured at a time.
const ROWS: usize = 16;

/// The signed distance in pixels from each pixel's centre to the border of a mask `[H, W]`, negative inside.
///
/// Exact: the root of a whole number, less the half pixel from the nearest pixel on the other side to the border. In a mask
/// without a border all are as far away as width and height together.
///
/// # Errors
/// The mask has not `width` times `height` pixels.
pub fn border_distances(inside: &[bool], width: usize, height: usize) -> Result<Vec<f32>, ShapeError> {
    ShapeError::check("mask", width * height, inside.len())?;
    let upright = upright_distances(inside, width, width + height);
    let mut distances = vec![0.0; inside.len()];
    let piece = (ROWS * width).max(1);
    (
        inside.par_chunks(piece),
        upright.par_chunks(piece),
        distances.par_chunks_mut(piece),
    )
        .into_par_iter()
        .for_each(|(inside, upright, distances)| {
            let mut envelope = Envelope::default();
            let rows = inside.chunks_exact(width).zip(upright.chunks_exact(width));
            for ((inside, upright), distances) in rows.zip(distances.chunks_exact_mut(width)) {
                let mut from = 0;
                for run in inside.chunk_by(|a, b| a == b) {
                    let to = from + run.len();
                    envelope.measure(upright, from, to, &mut distances[from..to]);
                    if run[0] {
                        distances[from..to]
                            .iter_mut()
                            .for_each(|distance| *distance = -*distance);
                    }
                    from = to;
                }
            }
        });
    Ok(distances)
}

/// How many rows each pixel is from the next one of its column on the other side of the border, or `far`.
fn upright_distances(inside: &[bool], width: usize, far: usize) -> Vec<usize> {
    let mut upright = vec![far; inside.len()];
    let height = inside.len().checked_div(width).unwrap_or(0);
    let mut step = |row: usize, before: usize| {
        for column in 0..width {
            let (here, there) = (row * width + column, before * width + column);
            let distance = if inside[here] == inside[there] {
                upright[there] + 1
            } else {
                1
            };
            upright[here] = upright[here].min(distance);
        }
    };
    (1..height).for_each(|row| step(row, row - 1));
    (1..height).rev().for_each(|row| step(row - 1, row));
    upright
}

/// The lower envelope of parabolas over a row, one for each place that may be the nearest (Meijster et al., 2000).
#[derive(Default)]
struct Envelope {
    /// The place of each parabola, and where on the row it begins to be the lowest.
    parts: Vec<(i64, i64)>,
}

impl Envelope {
    /// The distances of a run `from..to` of a row in which all pixels lie on one side of the border.
    ///
    /// Nothing beyond its two neighbours is nearer than they are.
    fn measure(&mut self, upright: &[usize], from: usize, to: usize, distances: &mut [f32]) {
        let run = from as i64..to as i64;
        let square = |place: i64| {
            if run.contains(&place) {
                (upright[place as usize] as i64).pow(2)
            } else {
                0
            }
        };
        let value = |x: i64, place: i64| (x - place).pow(2) + square(place);
        let first = run.start - i64::from(from > 0);
        let last = run.end + i64::from(to < upright.len());
        self.parts.clear();
        self.parts.push((first, first));
        for place in first + 1..last {
            while let Some(&(other, begin)) = self.parts.last()
                && value(begin, other) > value(begin, place)
            {
                self.parts.pop();
            }
            let begin = self.parts.last().map_or(first, |&(other, _)| {
                let meet = place.pow(2) - other.pow(2) + square(place) - square(other);
                1 + meet.div_euclid(2 * (place - other))
            });
            if begin < run.end {
                self.parts.push((place, begin));
            }
        }
        for (x, distance) in run.clone().rev().zip(distances.iter_mut().rev()) {
            while self.parts.len() > 1 && self.parts.last().is_some_and(|&(_, begin)| begin > x) {
                self.parts.pop();
            }
            let nearest = self.parts.last().map_or(0, |&(place, _)| value(x, place));
            *distance = ((nearest as f64).sqrt() - 0.5) as f32;
        }
    }
}

//! Pictures between their pixels.

use crate::TrackError;

/// Grey values, and how much of each pixel shows what is tracked.
#[derive(Clone, Copy, Debug)]
pub struct Picture<'a> {
    pub(crate) grey: &'a [f32],
    pub(crate) shown: &'a [f32],
    width: usize,
    height: usize,
}

impl<'a> Picture<'a> {
    /// A picture from its pixels, row by row.
    ///
    /// # Errors
    ///
    /// A picture without pixels, or lengths that are not `width * height`.
    pub fn new(grey: &'a [f32], shown: &'a [f32], width: usize, height: usize) -> Result<Self, TrackError> {
        let pixels = width.saturating_mul(height);
        if pixels == 0 {
            return Err(TrackError::size("pixels", 0, 1));
        }
        for (what, plane) in [("grey", grey), ("shown", shown)] {
            if plane.len() != pixels {
                return Err(TrackError::length(what, pixels, plane.len()));
            }
        }
        Ok(Self {
            grey,
            shown,
            width,
            height,
        })
    }

    /// Whether a place is within the picture.
    pub(crate) fn holds(&self, [x, y]: [f32; 2]) -> bool {
        x > 0.0 && y > 0.0 && x < self.width as f32 && y < self.height as f32
    }

    /// A plane's value at a place.
    pub(crate) fn at(&self, plane: &[f32], [x, y]: [f32; 2]) -> f32 {
        let (left, right, across) = between(x, self.width);
        let (top, bottom, down) = between(y, self.height);
        let line = |row: usize| {
            let row = &plane[row * self.width..][..self.width];
            row[left] + across * (row[right] - row[left])
        };
        let above = line(top);
        above + down * (line(bottom) - above)
    }

    /// A plane's values at the places of an upright square of `2 * half + 1` samples a side about `middle`.
    pub(crate) fn square(&self, plane: &[f32], middle: [f32; 2], half: usize, values: &mut [f32]) {
        let side = 2 * half + 1;
        let reach = half as f32;
        let (x, y) = (middle[0] - 0.5 - reach, middle[1] - 0.5 - reach);
        // All places lie alike between their pixels. Where the border cuts in, each is looked up.
        let inside = x >= 0.0
            && y >= 0.0
            && x + (side as f32) < self.width as f32 - 1.0
            && y + (side as f32) < self.height as f32 - 1.0;
        if !inside {
            for (row, values) in values.chunks_exact_mut(side).take(side).enumerate() {
                for (column, value) in values.iter_mut().enumerate() {
                    let offset = [column as f32 - reach, row as f32 - reach];
                    *value = self.at(plane, [middle[0] + offset[0], middle[1] + offset[1]]);
                }
            }
            return;
        }
        let (left, top) = (x as usize, y as usize);
        let (across, down) = (x - left as f32, y - top as f32);
        for (row, values) in values.chunks_exact_mut(side).take(side).enumerate() {
            let above = &plane[(top + row) * self.width + left..][..side + 1];
            let below = &plane[(top + row + 1) * self.width + left..][..side + 1];
            for column in 0..side {
                let upper = above[column] + across * (above[column + 1] - above[column]);
                let lower = below[column] + across * (below[column + 1] - below[column]);
                values[column] = upper + down * (lower - upper);
            }
        }
    }

    /// A plane's values at places about `middle`, none of them further from it than `reach` along an axis.
    pub(crate) fn scattered(
        &self,
        plane: &[f32],
        middle: [f32; 2],
        offsets: &[[f32; 2]],
        reach: [f32; 2],
        values: &mut [f32],
    ) {
        let (x, y) = (middle[0] - 0.5, middle[1] - 0.5);
        let inside = x - reach[0] >= 0.0
            && y - reach[1] >= 0.0
            && x + reach[0] < self.width as f32 - 1.5
            && y + reach[1] < self.height as f32 - 1.5;
        if !inside {
            for (value, [dx, dy]) in values.iter_mut().zip(offsets) {
                *value = self.at(plane, [middle[0] + dx, middle[1] + dy]);
            }
            return;
        }
        for (value, [dx, dy]) in values.iter_mut().zip(offsets) {
            let (x, y) = (x + dx, y + dy);
            // Not below 0 but by rounding, from where this goes to 0.
            let (column, row) = (x as i32, y as i32);
            let (across, down) = (x - column as f32, y - row as f32);
            let first = row as usize * self.width + column as usize;
            let window = &plane[first..][..self.width + 2];
            let above = window[0] + across * (window[1] - window[0]);
            let (left, right) = (window[self.width], window[self.width + 1]);
            let below = left + across * (right - left);
            *value = above + down * (below - above);
        }
    }
}

/// The two pixels that a coordinate lies between, and how far it is from the first to the second.
fn between(coordinate: f32, size: usize) -> (usize, usize, f32) {
    let last = size - 1;
    let place = (coordinate - 0.5).clamp(0.0, last as f32);
    let first = (place as usize).min(last);
    (first, (first + 1).min(last), place - first as f32)
}

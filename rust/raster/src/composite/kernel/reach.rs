//! Which blocks of a tile each of its splats reaches.

use super::{BLOCK, MAX_SIDE, TileTask, WORD};
use crate::math::real::Real;
use crate::project::splat::{Splat, log_threshold};
use crate::project::tiles::padded_reach;

/// Rows of blocks in the largest tile, and blocks in such a row.
const ROWS: usize = MAX_SIDE / BLOCK;

/// Slack in px, outwards: rounding must not lose a pixel.
const SLACK: f64 = 0.02;

type Column<U> = [U; WORD];

/// The ellipses {u² + v² ≤ reach} of some splats, in columns, so that the loops over them vectorise.
pub(super) struct Outlines<T> {
    /// From the first pixel centre of the tile.
    xs: Column<T>,
    ys: Column<T>,
    w11s: Column<T>,
    w22s: Column<T>,
    slopes: Column<T>,
    rights: Column<T>,
    half_heights: Column<T>,
    log_opacities: Column<T>,
    /// First pixel centre of the tile, from its anchor.
    first: [T; 2],
    log_threshold: T,
    /// Blocks along a side of the tile.
    side: usize,
}

impl<T: Real> Outlines<T> {
    #[inline(always)]
    pub(super) fn new(task: &TileTask<'_, T>) -> Self {
        let column = [T::ZERO; WORD];
        Self {
            xs: column,
            ys: column,
            w11s: column,
            w22s: column,
            slopes: column,
            rights: column,
            half_heights: column,
            log_opacities: column,
            first: task.first_centre(),
            log_threshold: log_threshold(task.limits),
            side: task.side,
        }
    }

    /// Puts a splat with this centre from the tile's anchor in a place.
    #[inline(always)]
    pub(super) fn set(&mut self, place: usize, splat: &Splat<T>, [x, y]: [T; 2]) {
        let i = place & (WORD - 1);
        self.xs[i] = x - self.first[0];
        self.ys[i] = y - self.first[1];
        self.w11s[i] = splat.w11;
        self.w22s[i] = splat.w22;
        self.slopes[i] = splat.slope;
        self.rights[i] = splat.right;
        self.half_heights[i] = splat.half_height;
        self.log_opacities[i] = splat.log_opacity;
    }

    /// For the splat in each place the blocks, a bit for each, whose pixel centres' bounding box meets its ellipse. Of no
    /// meaning where no splat was put.
    ///
    /// By rows of blocks: between the first and the last pixel centres of a row the ellipse extends from one x to another,
    /// and it meets the blocks between them.
    #[inline(always)]
    pub(super) fn blocks(&self) -> [u64; WORD] {
        let (tall, slack) = (T::of(BLOCK as f64 - 1.0), T::of(SLACK));
        let (per_block, most) = (T::of(1.0 / BLOCK as f64), T::of(self.side as f64));
        let (mut reaches, mut inverses) = ([T::ZERO; WORD], [T::ZERO; WORD]);
        for i in 0..WORD {
            reaches[i] = padded_reach(self.log_opacities[i] - self.log_threshold);
            inverses[i] = T::ONE / self.w11s[i];
        }
        // In halves: integers of the width of floats, for full vectors.
        let mut halves = [[0u32; WORD]; 2];
        let mut top = T::ZERO;
        for row in 0..self.side.min(ROWS) {
            let (masks, shift) = (&mut halves[row * self.side / 32], row * self.side % 32);
            for i in 0..WORD {
                let (x, slope, right) = (self.xs[i], self.slopes[i], self.rights[i]);
                let (reach, w22, inverse_w11) = (reaches[i], self.w22s[i], inverses[i]);
                let top = top - self.ys[i];
                let low = top.greater(-self.half_heights[i]);
                let high = (top + tall).lesser(self.half_heights[i]);
                let half_width = |dy: T| {
                    let v = w22 * dy;
                    (reach - v * v).greater(T::ZERO).sqrt() * inverse_w11
                };
                // The row's extreme points: those of the ellipse, or where its edge leaves the row.
                let (left_at, right_at) = ((-right).limit(low, high), right.limit(low, high));
                let left = x + slope * left_at - half_width(left_at) - tall - slack;
                let right = x + slope * right_at + half_width(right_at) + slack;
                let first = (left * per_block).limit(T::ZERO, most).ceiling();
                let past = (right * per_block).limit(T::ZERO, most).ceiling();
                let bits = ((1u32 << past) - 1) & !((1u32 << first) - 1);
                masks[i] |= (if low <= high { bits } else { 0 }) << shift;
            }
            top += T::of(BLOCK as f64);
        }
        std::array::from_fn(|i| u64::from(halves[0][i]) | u64::from(halves[1][i]) << 32)
    }
}

//! Which tiles see which splats, front to back.

use crate::error::RasterError;
use crate::project::{Projected, Splat};
use crate::real::Real;
use crate::sort::radix_sort;

/// How an image is cut into square tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct TileGrid {
    pub(crate) tile_size: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) columns: usize,
    pub(crate) rows: usize,
}

impl TileGrid {
    pub(crate) fn new(width: usize, height: usize, tile_size: usize) -> Self {
        Self {
            tile_size,
            width,
            height,
            columns: width.div_ceil(tile_size),
            rows: height.div_ceil(tile_size),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// Pixels of a tile, whether or not they are in the image.
    pub(crate) fn pixels_per_tile(&self) -> usize {
        self.tile_size * self.tile_size
    }

    /// Top-left pixel of a tile.
    pub(crate) fn origin(&self, tile: usize) -> (usize, usize) {
        (
            (tile % self.columns) * self.tile_size,
            (tile / self.columns) * self.tile_size,
        )
    }
}

/// For every tile the splats that may reach it, front to back. A *rank* is a position in depth order.
#[derive(Debug)]
pub(crate) struct TileBins {
    /// Tile t owns `ranks[offsets[t]..offsets[t + 1]]`.
    pub(crate) offsets: Vec<u32>,
    pub(crate) ranks: Vec<u32>,
    /// The splat of rank r owns `positions[starts[r]..starts[r + 1]]`: where in `ranks` it stands, tile by tile.
    pub(crate) starts: Vec<u32>,
    pub(crate) positions: Vec<u32>,
}

/// Puts the splats in order of depth, ties by index.
pub(crate) fn sort_by_depth<T: Real>(projected: &mut Projected<T>) {
    let mut order: Vec<(T::Key, u32)> = projected
        .splats
        .iter()
        .zip(0..)
        .map(|(splat, i)| (splat.depth.key(), i))
        .collect();
    radix_sort(&mut order);
    projected.ids = order.iter().map(|&(_, i)| projected.ids[i as usize]).collect();
    projected.splats = order.iter().map(|&(_, i)| projected.splats[i as usize]).collect();
}

/// A little more than `reach`: culling must never drop a pair that the compositor, rounding differently, would keep.
#[inline(always)]
pub(crate) fn padded_reach<T: Real>(reach: T) -> T {
    reach * T::of(1.001) + T::of(0.01)
}

/// The ellipse {u² + v² ≤ reach} of a splat, ready to be cut by rows of tiles.
struct Ellipse<T> {
    x: T,
    y: T,
    reach: T,
    w22: T,
    /// dx of the middle of a row, per dy.
    slope: T,
    inverse_w11: T,
    /// dy of the rightmost point.
    right: T,
    half_height: T,
}

impl<T: Real> Ellipse<T> {
    fn new(splat: &Splat<T>) -> Self {
        let reach = padded_reach(splat.reach);
        let (inverse_w11, inverse_w22) = (T::ONE / splat.w11, T::ONE / splat.w22);
        let tilt = -splat.w12 * inverse_w22;
        let half_height = reach.sqrt() * inverse_w22;
        Self {
            x: splat.x,
            y: splat.y,
            reach,
            w22: splat.w22,
            slope: -splat.w12 * inverse_w11,
            inverse_w11,
            right: half_height * (tilt / (T::ONE + tilt * tilt).sqrt()),
            half_height,
        }
    }

    /// Least and greatest x of the ellipse between two heights.
    #[inline(always)]
    fn columns(&self, top: T, bottom: T) -> (T, T) {
        let low = (top - self.y).greater(-self.half_height);
        let high = (bottom - self.y).lesser(self.half_height);
        let half_width = |dy: T| {
            let v = self.w22 * dy;
            (self.reach - v * v).greater(T::ZERO).sqrt() * self.inverse_w11
        };
        let (left_at, right_at) = ((-self.right).limit(low, high), self.right.limit(low, high));
        (
            self.x + self.slope * left_at - half_width(left_at),
            self.x + self.slope * right_at + half_width(right_at),
        )
    }
}

/// First and one-past-last tile along an axis with a pixel centre in [low, high]; empty ranges are (0, 0).
#[inline(always)]
fn tile_range<T: Real>(low: T, high: T, tile_size: usize, pixels: usize) -> (usize, usize) {
    let (half, slack, end) = (T::of(0.5), T::of(0.01), T::of(pixels as f64));
    // Centre i + ½ is in if low − ½ ≤ i ≤ high − ½. Truncation is the floor, everything being at least 0.
    let first = (low - half - slack).limit(T::ZERO, end);
    let whole = first.truncate();
    let first = whole + usize::from(T::of(whole as f64) < first);
    let past = (high + half + slack).limit(T::ZERO, end).truncate();
    if first >= past {
        return (0, 0);
    }
    // Tile sizes are powers of two; a division would cost more than all the rest.
    let shift = tile_size.trailing_zeros();
    (first >> shift, ((past - 1) >> shift) + 1)
}

/// Lists, for every tile for which `wanted` holds, the splats (in depth order) whose ellipse meets it.
pub(crate) fn bin_tiles<T: Real>(
    splats: &[Splat<T>],
    grid: &TileGrid,
    wanted: Option<&[bool]>,
) -> Result<TileBins, RasterError> {
    let mut tiles: Vec<u32> = Vec::with_capacity(splats.len() * 4);
    let mut starts = Vec::with_capacity(splats.len() + 1);
    starts.push(0);
    let mut push_row = |row: usize, (first, last): (usize, usize)| {
        for tile in row * grid.columns + first..row * grid.columns + last {
            if wanted.is_none_or(|wanted| wanted[tile]) {
                tiles.push(tile as u32);
            }
        }
        tiles.len()
    };
    for splat in splats {
        let mut count = starts[starts.len() - 1] as usize;
        if splat.reach.is_finite() {
            let ellipse = Ellipse::new(splat);
            let (top, bottom) = tile_range(
                splat.y - ellipse.half_height,
                splat.y + ellipse.half_height,
                grid.tile_size,
                grid.height,
            );
            for row in top..bottom {
                let first_centre = T::of((row * grid.tile_size) as f64 + 0.5);
                let last_centre = first_centre + T::of(grid.tile_size as f64 - 1.0);
                let (left, right) = ellipse.columns(first_centre, last_centre);
                count = push_row(row, tile_range(left, right, grid.tile_size, grid.width));
            }
        } else {
            for row in 0..grid.rows {
                count = push_row(row, (0, grid.columns));
            }
        }
        starts.push(u32::try_from(count).map_err(|_| RasterError::TooManyIntersections)?);
    }

    // A counting sort by tile keeps the depth order within each.
    let mut offsets = vec![0u32; grid.len() + 1];
    for &tile in &tiles {
        offsets[tile as usize + 1] += 1;
    }
    for tile in 0..grid.len() {
        offsets[tile + 1] += offsets[tile];
    }
    let mut next = offsets.clone();
    let mut ranks = vec![0u32; tiles.len()];
    let mut positions = vec![0u32; tiles.len()];
    for rank in 0..splats.len() {
        for entry in starts[rank] as usize..starts[rank + 1] as usize {
            let slot = &mut next[tiles[entry] as usize];
            ranks[*slot as usize] = rank as u32;
            positions[entry] = *slot;
            *slot += 1;
        }
    }
    Ok(TileBins {
        offsets,
        ranks,
        starts,
        positions,
    })
}

//! Tiles, and which of them a Gaussian reaches.

use crate::math::real::Real;
use crate::memory::pool::{bytes_of, filled};
use crate::simd::prefetch;

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

/// A little more than `reach`, because culling must keep every pixel that the compositor, which rounds differently, may
/// find inside.
#[inline(always)]
pub(crate) fn padded_reach<T: Real>(reach: T) -> T {
    reach * T::of(1.001) + T::of(0.01)
}

/// First and one-past-last pixel with its centre in [low, high]; not in order if there is none.
#[inline(always)]
pub(crate) fn pixel_range<T: Real>(low: T, high: T, pixels: T) -> (u32, u32) {
    // Centre i + ½ is in if low − ½ ≤ i ≤ high − ½. Rounding to the nearest with a little slack outwards.
    let slack = T::of(0.02);
    let first = (low - slack).limit(T::ZERO, pixels).nearest();
    let past = (high + slack).limit(T::ZERO, pixels).nearest();
    (first, past)
}

/// Rows of tiles that are cut together.
const ROWS: usize = 64;
type Column<U> = [U; ROWS];

/// The ellipse {u² + v² ≤ reach} of a splat, ready to be cut by rows of tiles.
#[derive(Clone, Copy)]
pub(crate) struct Ellipse<T> {
    pub(crate) x: T,
    pub(crate) y: T,
    pub(crate) reach: T,
    pub(crate) w22: T,
    pub(crate) inverse_w11: T,
    /// dx of the middle of a row, per dy.
    pub(crate) slope: T,
    /// dy of the rightmost point.
    pub(crate) right: T,
    pub(crate) half_height: T,
}

/// Cuts ellipses by rows of tiles, many at once.
pub(crate) struct Cutter<'a, T> {
    grid: &'a TileGrid,
    /// Tiles that are wanted; all if absent.
    wanted: Option<&'a [bool]>,
    ellipses: [Column<T>; 8],
    rows: Column<u32>,
    /// Which Gaussian each row belongs to.
    owners: Column<u32>,
    used: usize,
}

impl<'a, T: Real> Cutter<'a, T> {
    pub(crate) fn new(grid: &'a TileGrid, wanted: Option<&'a [bool]>) -> Self {
        Self {
            grid,
            wanted,
            ellipses: [[T::ZERO; ROWS]; 8],
            rows: [0; ROWS],
            owners: [0; ROWS],
            used: 0,
        }
    }

    /// Adds the rows of tiles `rows` of a splat, which must not come before those added earlier.
    #[inline(always)]
    pub(crate) fn push(
        &mut self,
        owner: usize,
        ellipse: &Ellipse<T>,
        rows: std::ops::Range<u32>,
        cover: &mut Cover,
    ) {
        let e = ellipse;
        let values = [
            e.x,
            e.y,
            e.reach,
            e.w22,
            e.inverse_w11,
            e.slope,
            e.right,
            e.half_height,
        ];
        for row in rows {
            if self.used == ROWS {
                self.flush(cover);
            }
            let at = self.used & (ROWS - 1);
            for (column, value) in self.ellipses.iter_mut().zip(values) {
                column[at] = value;
            }
            self.rows[at] = row;
            self.owners[at] = owner as u32;
            self.used += 1;
        }
    }

    /// Lists the tiles of the rows pushed since the last flush.
    #[inline(always)]
    pub(crate) fn flush(&mut self, cover: &mut Cover) {
        let (mut firsts, mut counts) = ([0u32; ROWS], [0u32; ROWS]);
        let tall = T::of(self.grid.tile_size as f64 - 1.0);
        let width = T::of(self.grid.width as f64);
        // Tile sizes are powers of two; a division would cost more than all the rest.
        let shift = self.grid.tile_size.trailing_zeros();
        let columns = self.grid.columns as u32;
        let [xs, ys, reaches, w22s, inverses, slopes, rights, half_heights] = &self.ellipses;
        for i in 0..ROWS {
            let (reach, w22, inverse_w11) = (reaches[i], w22s[i], inverses[i]);
            // From the row's first pixel centres.
            let top = T::of(f64::from(self.rows[i] << shift) + 0.5) - ys[i];
            let low = top.greater(-half_heights[i]);
            let high = (top + tall).lesser(half_heights[i]);
            let half_width = |dy: T| {
                let v = w22 * dy;
                (reach - v * v).greater(T::ZERO).sqrt() * inverse_w11
            };
            // The row's extreme points: those of the ellipse, or where its edge leaves the row.
            let (left_at, right_at) = ((-rights[i]).limit(low, high), rights[i].limit(low, high));
            let left = xs[i] + slopes[i] * left_at - half_width(left_at);
            let right = xs[i] + slopes[i] * right_at + half_width(right_at);
            let (first, past) = pixel_range(left, right, width);
            firsts[i] = self.rows[i] * columns + (first >> shift);
            let count = (past.wrapping_sub(1) >> shift)
                .wrapping_sub(first >> shift)
                .wrapping_add(1);
            counts[i] = if first < past { count } else { 0 };
        }
        for i in 0..self.used.min(ROWS) {
            cover.push(self.owners[i] as usize, firsts[i], counts[i], self.wanted);
        }
        self.used = 0;
    }
}

/// Which tiles a packet of Gaussians reaches.
#[derive(Debug, Default)]
pub(crate) struct Cover {
    /// Gaussian by Gaussian; beyond `end` of no meaning.
    tiles: Vec<u32>,
    end: usize,
    /// Whether intersections are only counted, in `end`, and not listed.
    pub(crate) counting: bool,
    /// Where in `tiles` those of each Gaussian of the packet begin, and where the last end.
    begins: Vec<u32>,
    /// Gaussians of the packet that some pixel may see.
    pub(crate) visible: usize,
    /// Intersections of all packets before this one.
    base: u32,
}

impl Cover {
    pub(crate) fn bytes(&self) -> usize {
        bytes_of(&self.tiles) + bytes_of(&self.begins)
    }

    /// Gaussians in the packet.
    pub(crate) fn len(&self) -> usize {
        self.begins.len() - 1
    }

    /// Starts over for `len` Gaussians.
    pub(crate) fn clear(&mut self, len: usize) {
        self.end = 0;
        filled(&mut self.begins, len + 1, 0);
    }

    /// Adds consecutive tiles to those of a Gaussian, which must not come before those added earlier.
    #[inline(always)]
    fn push(&mut self, owner: usize, first: u32, count: u32, wanted: Option<&[bool]>) {
        /// Tiles written at once, needed or not. Their number varies too much for a branch to predict.
        const AT_ONCE: usize = 8;
        if self.counting {
            let tiles = first as usize..(first + count) as usize;
            self.end += wanted.map_or(tiles.len(), |wanted| wanted[tiles].iter().filter(|&&w| w).count());
            return;
        }
        let end = self.end + count as usize;
        if self.tiles.len() < end + AT_ONCE {
            self.tiles.resize((end + AT_ONCE).max(2 * self.tiles.len()), 0);
        }
        if let Some(wanted) = wanted {
            for tile in (first..first + count).filter(|&tile| wanted[tile as usize]) {
                self.tiles[self.end] = tile;
                self.end += 1;
            }
        } else {
            let mut tile = first;
            for tiles in self.tiles[self.end..end + AT_ONCE].chunks_exact_mut(AT_ONCE) {
                for (k, place) in tiles.iter_mut().enumerate() {
                    *place = tile + k as u32;
                }
                tile += AT_ONCE as u32;
            }
            self.end = end;
        }
        self.begins[owner + 1] = self.end as u32;
    }

    /// Gaussians that reach the first tile, or none.
    #[cfg(test)]
    pub(crate) fn of_single_tiles(len: usize, reaches: impl Fn(usize) -> bool) -> Self {
        let mut cover = Self::default();
        cover.clear(len);
        for local in (0..len).filter(|&local| reaches(local)) {
            cover.push(local, 0, 1, None);
        }
        cover.finish();
        cover
    }

    /// Completes the beginnings: Gaussians that reach nothing begin where the one before ends.
    pub(crate) fn finish(&mut self) {
        let mut last = 0;
        for begin in &mut self.begins {
            last = last.max(*begin);
            *begin = last;
        }
    }

    /// How many intersections, listed or not.
    pub(crate) fn count(&self) -> usize {
        self.end
    }

    /// The tile of each intersection of the packet.
    pub(crate) fn tiles(&self) -> &[u32] {
        &self.tiles[..self.end]
    }

    /// Whether a Gaussian of the packet reaches any tile.
    #[inline(always)]
    pub(crate) fn reaches(&self, local: usize) -> bool {
        self.begins[local] < self.begins[local + 1]
    }

    /// Starts to bring the tiles of a Gaussian into the first cache.
    #[inline(always)]
    pub(crate) fn prefetch(&self, local: usize) {
        prefetch(&self.tiles, self.begins[local] as usize);
    }

    pub(crate) fn tiles_of(&self, local: usize) -> &[u32] {
        &self.tiles[self.begins[local] as usize..self.begins[local + 1] as usize]
    }

    /// Numbers the packet's intersections from `base` on.
    pub(crate) fn number(&mut self, base: u32) {
        self.base = base;
    }

    /// The numbers of a Gaussian's intersections.
    #[inline(always)]
    pub(crate) fn intersections_of(&self, local: usize) -> std::ops::Range<usize> {
        (self.base + self.begins[local]) as usize..(self.base + self.begins[local + 1]) as usize
    }
}

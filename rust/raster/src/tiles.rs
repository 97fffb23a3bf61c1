//! Which tiles see which splats, front to back.

use crate::chunk::CHUNK;
use crate::error::RasterError;
use crate::pool::{bytes_of, filled, stale};
use crate::project::Splat;
use crate::real::Real;
use crate::sort::{SortScratch, radix_sort_with};

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

/// A little more than `reach`: culling must never drop a pair that the compositor, rounding differently, would keep.
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

/// Rows of tiles waiting to be cut out of ellipses together.
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
    /// Whose row it is.
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

    /// Lists the tiles of the rows that wait.
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

/// Which tiles a chunk of Gaussians reaches.
#[derive(Debug, Default)]
pub(crate) struct Cover {
    /// Gaussian by Gaussian; what lies behind `end` is to be overwritten.
    tiles: Vec<u32>,
    end: usize,
    /// Whether pairs are only counted, in `end`: there are too many to list before their number is known.
    pub(crate) counting: bool,
    /// Where in `tiles` those of each Gaussian of the chunk begin, and where the last end.
    begins: Vec<u32>,
    /// Gaussians of the chunk that some pixel may see.
    pub(crate) visible: usize,
    /// (Gaussian, tile) pairs of all chunks before this one.
    base: u32,
}

impl Cover {
    pub(crate) fn bytes(&self) -> usize {
        bytes_of(&self.tiles) + bytes_of(&self.begins)
    }

    /// Gaussians in the chunk.
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
        /// Tiles written at once, needed or not: how many are is hard for a branch to predict.
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

    /// Completes the beginnings: Gaussians that reach nothing begin where the one before ends.
    pub(crate) fn finish(&mut self) {
        let mut last = 0;
        for begin in &mut self.begins {
            last = last.max(*begin);
            *begin = last;
        }
    }

    /// How many (Gaussian, tile) pairs, listed or not.
    pub(crate) fn count(&self) -> usize {
        self.end
    }

    /// (Gaussian, tile) pairs of the chunk.
    fn pairs(&self) -> &[u32] {
        &self.tiles[..self.end]
    }

    /// Whether a Gaussian of the chunk reaches any tile.
    #[inline(always)]
    pub(crate) fn reaches(&self, local: usize) -> bool {
        self.begins[local] < self.begins[local + 1]
    }

    fn tiles_of(&self, local: usize) -> &[u32] {
        &self.tiles[self.begins[local] as usize..self.begins[local + 1] as usize]
    }

    /// Where a Gaussian's own part of [`TileBins::positions`] is.
    #[inline(always)]
    pub(crate) fn pairs_of(&self, local: usize) -> std::ops::Range<usize> {
        (self.base + self.begins[local]) as usize..(self.base + self.begins[local + 1]) as usize
    }
}

/// For every tile the splats that may reach it, front to back.
#[derive(Debug, Default)]
pub(crate) struct TileBins {
    /// Tile t owns `ranks[offsets[t]..offsets[t + 1]]`.
    pub(crate) offsets: Vec<u32>,
    /// Indices of Gaussians.
    pub(crate) ranks: Vec<u32>,
    /// Gaussian by Gaussian and tile by tile: where in `ranks` it stands.
    pub(crate) positions: Vec<u32>,
}

impl TileBins {
    pub(crate) fn bytes(&self) -> usize {
        bytes_of(&self.offsets) + bytes_of(&self.ranks) + bytes_of(&self.positions)
    }
}

/// What sorting and binning need besides their results.
#[derive(Debug)]
pub(crate) struct BinScratch<T: Real> {
    order: Vec<(T::Key, u32)>,
    sort: SortScratch<T::Key>,
    next: Vec<u32>,
}

impl<T: Real> Default for BinScratch<T> {
    fn default() -> Self {
        Self {
            order: Vec::new(),
            sort: SortScratch::default(),
            next: Vec::new(),
        }
    }
}

impl<T: Real> BinScratch<T> {
    pub(crate) fn bytes(&self) -> usize {
        bytes_of(&self.order) + self.sort.bytes() + bytes_of(&self.next)
    }
}

/// Puts the Gaussians that reach some tile in order of depth, ties by index.
fn sort_by_depth<T: Real>(splats: &[Splat<T>], covers: &[Cover], scratch: &mut BinScratch<T>) {
    scratch.order.clear();
    for (chunk, (splats, cover)) in splats.chunks(CHUNK).zip(covers).enumerate() {
        let first = (chunk * CHUNK) as u32;
        let reached = splats
            .iter()
            .enumerate()
            .filter(|&(local, _)| cover.reaches(local));
        scratch
            .order
            .extend(reached.map(|(local, splat)| (splat.depth.key(), first + local as u32)));
    }
    radix_sort_with(&mut scratch.order, &mut scratch.sort);
}

/// Numbers the pairs of every chunk.
fn number_pairs(covers: &mut [Cover]) -> Result<(), RasterError> {
    let mut total = 0u32;
    for cover in covers.iter_mut() {
        cover.base = total;
        total = u32::try_from(cover.end)
            .ok()
            .and_then(|pairs| total.checked_add(pairs))
            .ok_or(RasterError::TooManyIntersections)?;
    }
    Ok(())
}

/// Counts the pairs of every tile.
fn count_pairs(covers: &[Cover], tiles: usize, offsets: &mut Vec<u32>) {
    let offsets = filled(offsets, tiles + 1, 0);
    for &tile in covers.iter().flat_map(Cover::pairs) {
        offsets[tile as usize + 1] += 1;
    }
    let mut sum = 0;
    for offset in offsets {
        sum += *offset;
        *offset = sum;
    }
}

/// Sorts splats by depth and lists those of every tile.
pub(crate) fn bin_tiles<T: Real>(
    splats: &[Splat<T>],
    covers: &mut [Cover],
    tiles: usize,
    scratch: &mut BinScratch<T>,
    bins: &mut TileBins,
) -> Result<(), RasterError> {
    number_pairs(covers)?;
    let covers = &*covers;
    rayon::join(
        || sort_by_depth(splats, covers, scratch),
        || count_pairs(covers, tiles, &mut bins.offsets),
    );
    fill_bins(covers, scratch, bins);
    Ok(())
}

/// Lists the splats of every tile, after [`sort_by_depth`] and [`count_pairs`].
fn fill_bins<T: Real>(covers: &[Cover], scratch: &mut BinScratch<T>, bins: &mut TileBins) {
    let pairs = bins.offsets.last().map_or(0, |&end| end as usize);
    let ranks = stale(&mut bins.ranks, pairs);
    let positions = stale(&mut bins.positions, pairs);
    scratch.next.clear();
    scratch.next.extend_from_slice(&bins.offsets);
    for &(_, i) in &scratch.order {
        let (cover, local) = (&covers[i as usize / CHUNK], i as usize % CHUNK);
        let own = &mut positions[cover.pairs_of(local)];
        for (position, &tile) in own.iter_mut().zip(cover.tiles_of(local)) {
            let slot = &mut scratch.next[tile as usize];
            ranks[*slot as usize] = i;
            *position = *slot;
            *slot += 1;
        }
    }
}

//! Which splats a tile shows, front to back.

use rayon::prelude::*;

use crate::error::RasterError;
use crate::lists::radix_sort::{SortScratch, radix_sort_with};
use crate::math::real::Real;
use crate::memory::pool::{Buffers, bytes_of, filled, stale};
use crate::memory::shared_slice::Shared;
use crate::project::packet::PACKET_SIZE;
use crate::project::projected::Projected;
use crate::project::tiles::Cover;

/// For every tile the splats that may reach it, front to back.
#[derive(Debug, Default)]
pub(crate) struct TileLists {
    /// Tile t owns `entries[offsets[t]..offsets[t + 1]]`.
    pub(crate) offsets: Vec<u32>,
    /// The index of a Gaussian, and the number of its intersection with the tile, counted Gaussian by Gaussian and within
    /// each tile by tile.
    pub(crate) entries: Vec<[u32; 2]>,
}

impl Buffers for TileLists {
    fn bytes(&self) -> usize {
        bytes_of(&self.offsets) + bytes_of(&self.entries)
    }
}

/// What sorting and listing need besides their results.
#[derive(Debug)]
pub(crate) struct ListScratch<T: Real> {
    order: Vec<(T::Key, u32)>,
    sort: SortScratch<T::Key>,
    /// Per tile, where in its list the next splat from the front goes, and one past where the next from the back goes.
    fronts: Vec<u32>,
    backs: Vec<u32>,
    /// By segment of the order and by tile, where in its list the segment's next splat goes.
    segments: Vec<u32>,
}

impl<T: Real> Default for ListScratch<T> {
    fn default() -> Self {
        Self {
            order: Vec::new(),
            sort: SortScratch::default(),
            fronts: Vec::new(),
            backs: Vec::new(),
            segments: Vec::new(),
        }
    }
}

impl<T: Real> Buffers for ListScratch<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.order)
            + self.sort.bytes()
            + bytes_of(&self.fronts)
            + bytes_of(&self.backs)
            + bytes_of(&self.segments)
    }
}

/// Puts the Gaussians that reach some tile in order of depth, ties by index.
fn sort_by_depth<T: Real>(depths: &[T], covers: &[Cover], scratch: &mut ListScratch<T>) {
    let order = stale(&mut scratch.order, depths.len());
    let mut reached = 0;
    for (packet, (depths, cover)) in depths.chunks(PACKET_SIZE).zip(covers).enumerate() {
        let first = (packet * PACKET_SIZE) as u32;
        for (local, depth) in depths.iter().enumerate() {
            // Overwritten by the next if it reaches nothing, which is hard for a branch to predict.
            order[reached] = (depth.key(), first + local as u32);
            reached += usize::from(cover.reaches(local));
        }
    }
    scratch.order.truncate(reached);
    radix_sort_with(&mut scratch.order, &mut scratch.sort);
}

/// Numbers the intersections of every packet.
fn number_intersections(covers: &mut [Cover]) -> Result<(), RasterError> {
    let mut total = 0u32;
    for cover in covers.iter_mut() {
        cover.number(total);
        total = u32::try_from(cover.count())
            .ok()
            .and_then(|own| total.checked_add(own))
            .ok_or(RasterError::TooManyIntersections)?;
    }
    Ok(())
}

/// Counts the intersections of every tile.
fn count_by_tile(covers: &[Cover], tiles: usize, offsets: &mut Vec<u32>) {
    let offsets = filled(offsets, tiles + 1, 0);
    for &tile in covers.iter().flat_map(Cover::tiles) {
        offsets[tile as usize + 1] += 1;
    }
    let mut sum = 0;
    for offset in offsets {
        sum += *offset;
        *offset = sum;
    }
}

/// Sorts the projected splats by depth and lists those of every tile.
pub(crate) fn bin_splats<T: Real>(
    projected: &mut Projected<T>,
    tiles: usize,
    scratch: &mut ListScratch<T>,
    lists: &mut TileLists,
) -> Result<(), RasterError> {
    number_intersections(projected.covers_mut())?;
    let (depths, covers) = (&projected.depths[..], projected.covers());
    rayon::join(
        || sort_by_depth(depths, covers, scratch),
        || count_by_tile(covers, tiles, &mut lists.offsets),
    );
    fill_lists(covers, scratch, lists);
    Ok(())
}

/// The lists of all tiles while they are made.
struct Lists<'a> {
    covers: &'a [Cover],
    entries: Shared<'a>,
}

impl Lists<'_> {
    /// The packet of a Gaussian, and its number there.
    #[inline(always)]
    fn cover_of(&self, i: u32) -> (&Cover, usize) {
        (&self.covers[i as usize / PACKET_SIZE], i as usize % PACKET_SIZE)
    }

    /// Starts to bring the tiles of a Gaussian into the first cache.
    #[inline(always)]
    fn prefetch(&self, i: u32) {
        let (cover, local) = self.cover_of(i);
        cover.prefetch(local);
    }

    /// Puts a Gaussian into the list of each tile that it reaches, where `place` says.
    #[inline(always)]
    fn put(&self, i: u32, mut place: impl FnMut(u32) -> u32) {
        let (cover, local) = self.cover_of(i);
        for (number, &tile) in cover.intersections_of(local).zip(cover.tiles_of(local)) {
            self.entries.set(place(tile) as usize, [i, number as u32]);
        }
    }
}

/// Gaussians whose tiles are asked for ahead of the one being listed: in order of depth they lie anywhere.
const AHEAD: usize = 8;

/// Lists the splats of every tile, after [`sort_by_depth`] and [`count_by_tile`].
fn fill_lists<T: Real>(covers: &[Cover], scratch: &mut ListScratch<T>, lists: &mut TileLists) {
    let intersections = lists.offsets.last().map_or(0, |&end| end as usize);
    let out = Lists {
        covers,
        entries: Shared::new(stale(&mut lists.entries, intersections)),
    };
    scratch.fronts.clone_from(&lists.offsets);
    match rayon::current_num_threads() {
        1 | 2 => out.fill_from_both_ends(scratch, &lists.offsets),
        threads => out.fill_by_segments(scratch, threads),
    }
}

impl Lists<'_> {
    /// The near half from the front of each list, at the same time the far half from its back: no work more than one
    /// thread has.
    fn fill_from_both_ends<T: Real>(&self, scratch: &mut ListScratch<T>, offsets: &[u32]) {
        let ListScratch {
            order, fronts, backs, ..
        } = scratch;
        backs.clear();
        backs.extend_from_slice(&offsets[1..]);
        let (near, far) = order.split_at(order.len() / 2);
        rayon::join(
            || self.fill_from_the_front(near, fronts),
            || {
                for (k, &(_, i)) in far.iter().enumerate().rev() {
                    if let Some(&(_, soon)) = k.checked_sub(AHEAD).and_then(|k| far.get(k)) {
                        self.prefetch(soon);
                    }
                    self.put(i, |tile| {
                        let last = &mut backs[tile as usize];
                        *last -= 1;
                        *last
                    });
                }
            },
        );
    }

    /// A segment of the order per thread, each where counting those before it says: one more walk through the tiles of
    /// all Gaussians, which more than two threads make up for.
    fn fill_by_segments<T: Real>(&self, scratch: &mut ListScratch<T>, segments: usize) {
        let ListScratch {
            order,
            fronts,
            segments: nexts,
            ..
        } = scratch;
        let tiles = fronts.len() - 1;
        let size = order.len().div_ceil(segments).max(1);
        let nexts = filled(nexts, segments * tiles, 0);
        nexts
            .par_chunks_mut(tiles)
            .zip(order.par_chunks(size))
            .for_each(|(counts, segment)| {
                for &(_, i) in segment {
                    let (cover, local) = self.cover_of(i);
                    for &tile in cover.tiles_of(local) {
                        counts[tile as usize] += 1;
                    }
                }
            });
        for counts in nexts.chunks_exact_mut(tiles) {
            for (next, front) in counts.iter_mut().zip(&mut *fronts) {
                (*next, *front) = (*front, *front + *next);
            }
        }
        nexts
            .par_chunks_mut(tiles)
            .zip(order.par_chunks(size))
            .for_each(|(nexts, segment)| self.fill_from_the_front(segment, nexts));
    }

    /// Lists the Gaussians of a part of the order, each tile's from `nexts` on.
    #[inline(always)]
    fn fill_from_the_front<K>(&self, order: &[(K, u32)], nexts: &mut [u32]) {
        for (k, &(_, i)) in order.iter().enumerate() {
            if let Some(&(_, soon)) = order.get(k + AHEAD) {
                self.prefetch(soon);
            }
            self.put(i, |tile| {
                let next = &mut nexts[tile as usize];
                *next += 1;
                *next - 1
            });
        }
    }
}

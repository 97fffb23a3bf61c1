//! Which splats a tile shows, front to back.

use rayon::prelude::*;

use crate::error::RasterError;
use crate::lists::depth_order::DepthOrder;
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
    order: DepthOrder<T::Key>,
    /// Per tile, where in its list the next splat from the front goes, and one past where the next from the back goes.
    fronts: Vec<u32>,
    backs: Vec<u32>,
    /// By segment of the order and by tile, where in its list the segment's next splat goes.
    segments: Vec<u32>,
}

impl<T: Real> Default for ListScratch<T> {
    fn default() -> Self {
        Self {
            order: DepthOrder::default(),
            fronts: Vec::new(),
            backs: Vec::new(),
            segments: Vec::new(),
        }
    }
}

impl<T: Real> Buffers for ListScratch<T> {
    fn bytes(&self) -> usize {
        self.order.bytes() + bytes_of(&self.fronts) + bytes_of(&self.backs) + bytes_of(&self.segments)
    }
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
    let intersections = covers.iter().map(Cover::count).sum();
    let out = Lists {
        covers,
        entries: Shared::new(stale(&mut lists.entries, intersections)),
    };
    let ListScratch {
        order,
        fronts,
        backs,
        segments,
    } = scratch;
    // A count by segment and tile costs more than it saves where tiles outnumber intersections.
    let threads = rayon::current_num_threads().min(1 + intersections / tiles.max(1));
    if threads > 2 {
        order.sort(depths, covers);
        out.fill_by_segments(order.pairs(), segments, threads, tiles, &mut lists.offsets);
    } else {
        rayon::join(
            || order.sort(depths, covers),
            || count_by_tile(covers, tiles, &mut lists.offsets),
        );
        fronts.clone_from(&lists.offsets);
        backs.clear();
        backs.extend_from_slice(&lists.offsets[1..]);
        out.fill_from_both_ends(order.pairs(), fronts, backs);
    }
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

impl Lists<'_> {
    /// The near half from the front of each list, at the same time the far half from its back: no work more than one
    /// thread has.
    fn fill_from_both_ends<K: Sync>(&self, order: &[(K, u32)], fronts: &mut [u32], backs: &mut [u32]) {
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

    /// A segment of the order per thread, each where counting those before it says.
    fn fill_by_segments<K: Sync>(
        &self,
        order: &[(K, u32)],
        nexts: &mut Vec<u32>,
        segments: usize,
        tiles: usize,
        offsets: &mut Vec<u32>,
    ) {
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
        offsets.clear();
        offsets.push(0);
        let mut sum = 0;
        for tile in 0..tiles {
            for next in nexts.iter_mut().skip(tile).step_by(tiles) {
                (*next, sum) = (sum, sum + *next);
            }
            offsets.push(sum);
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

//! Which splats a tile shows, front to back.

use crate::error::RasterError;
use crate::lists::radix_sort::{SortScratch, radix_sort_with};
use crate::math::real::Real;
use crate::memory::pool::{Buffers, bytes_of, filled, stale};
use crate::memory::shared_slice::Shared;
use crate::project::packet::PACKET_SIZE;
use crate::project::projected::Projected;
use crate::project::splat::Splat;
use crate::project::tiles::Cover;

/// For every tile the splats that may reach it, front to back.
#[derive(Debug, Default)]
pub(crate) struct TileLists {
    /// Tile t owns `gaussians[offsets[t]..offsets[t + 1]]`.
    pub(crate) offsets: Vec<u32>,
    /// Indices of Gaussians.
    pub(crate) gaussians: Vec<u32>,
    /// Intersection by intersection, Gaussian by Gaussian and within each tile by tile: where in `gaussians` it stands.
    pub(crate) positions: Vec<u32>,
}

impl Buffers for TileLists {
    fn bytes(&self) -> usize {
        bytes_of(&self.offsets) + bytes_of(&self.gaussians) + bytes_of(&self.positions)
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
}

impl<T: Real> Default for ListScratch<T> {
    fn default() -> Self {
        Self {
            order: Vec::new(),
            sort: SortScratch::default(),
            fronts: Vec::new(),
            backs: Vec::new(),
        }
    }
}

impl<T: Real> Buffers for ListScratch<T> {
    fn bytes(&self) -> usize {
        bytes_of(&self.order) + self.sort.bytes() + bytes_of(&self.fronts) + bytes_of(&self.backs)
    }
}

/// Puts the Gaussians that reach some tile in order of depth, ties by index.
fn sort_by_depth<T: Real>(splats: &[Splat<T>], covers: &[Cover], scratch: &mut ListScratch<T>) {
    let order = stale(&mut scratch.order, splats.len());
    let mut reached = 0;
    for (packet, (splats, cover)) in splats.chunks(PACKET_SIZE).zip(covers).enumerate() {
        let first = (packet * PACKET_SIZE) as u32;
        for (local, splat) in splats.iter().enumerate() {
            // Overwritten by the next if it reaches nothing, which is hard for a branch to predict.
            order[reached] = (splat.depth.key(), first + local as u32);
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
    let (splats, covers) = (&projected.splats[..], projected.covers());
    rayon::join(
        || sort_by_depth(splats, covers, scratch),
        || count_by_tile(covers, tiles, &mut lists.offsets),
    );
    fill_lists(covers, scratch, lists);
    Ok(())
}

/// The lists of all tiles while they are made.
struct Lists<'a> {
    covers: &'a [Cover],
    gaussians: Shared<'a>,
    positions: Shared<'a>,
}

impl Lists<'_> {
    /// Starts to bring the tiles of a Gaussian into the first cache.
    #[inline(always)]
    fn prefetch(&self, i: u32) {
        self.covers[i as usize / PACKET_SIZE].prefetch(i as usize % PACKET_SIZE);
    }

    /// Puts a Gaussian into the list of each tile that it reaches, where `place` says.
    #[inline(always)]
    fn put(&self, i: u32, mut place: impl FnMut(u32) -> u32) {
        let (cover, local) = (&self.covers[i as usize / PACKET_SIZE], i as usize % PACKET_SIZE);
        for (own, &tile) in cover.intersections_of(local).zip(cover.tiles_of(local)) {
            let at = place(tile);
            self.gaussians.set(at as usize, i);
            self.positions.set(own, at);
        }
    }
}

/// Gaussians whose tiles are asked for ahead of the one being listed: in order of depth they lie anywhere.
const AHEAD: usize = 8;

/// Lists the splats of every tile, after [`sort_by_depth`] and [`count_by_tile`]: the near half from the front of each
/// list, at the same time the far half from its back.
fn fill_lists<T: Real>(covers: &[Cover], scratch: &mut ListScratch<T>, lists: &mut TileLists) {
    let ListScratch {
        order, fronts, backs, ..
    } = scratch;
    let intersections = lists.offsets.last().map_or(0, |&end| end as usize);
    let out = Lists {
        covers,
        gaussians: Shared::new(stale(&mut lists.gaussians, intersections)),
        positions: Shared::new(stale(&mut lists.positions, intersections)),
    };
    fronts.clone_from(&lists.offsets);
    backs.clear();
    backs.extend_from_slice(&lists.offsets[1..]);
    let (near, far) = order.split_at(order.len() / 2);
    rayon::join(
        || {
            for (k, &(_, i)) in near.iter().enumerate() {
                if let Some(&(_, soon)) = near.get(k + AHEAD) {
                    out.prefetch(soon);
                }
                out.put(i, |tile| {
                    let next = &mut fronts[tile as usize];
                    *next += 1;
                    *next - 1
                });
            }
        },
        || {
            for (k, &(_, i)) in far.iter().enumerate().rev() {
                if let Some(&(_, soon)) = k.checked_sub(AHEAD).and_then(|k| far.get(k)) {
                    out.prefetch(soon);
                }
                out.put(i, |tile| {
                    let last = &mut backs[tile as usize];
                    *last -= 1;
                    *last
                });
            }
        },
    );
}

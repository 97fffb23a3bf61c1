//! Gaussians in order of depth.

use rayon::prelude::*;

use crate::lists::merge_runs::merge_runs;
use crate::lists::radix_sort::{SortScratch, radix_sort_with};
use crate::math::radix_key::RadixKey;
use crate::math::real::Real;
use crate::memory::pool::{bytes_of, stale};
use crate::project::packet::PACKET_SIZE;
use crate::project::tiles::Cover;

/// Packets of Gaussians that one thread sorts at least: below, merging costs more than it saves.
const LEAST_PACKETS: usize = 16;

/// Some Gaussians, sorted by depth.
#[derive(Debug)]
struct Run<K> {
    pairs: Vec<(K, u32)>,
    sort: SortScratch<K>,
}

/// Gaussians by depth, and the memory for sorting them.
#[derive(Debug)]
pub(crate) struct DepthOrder<K> {
    /// Of consecutive Gaussians; the first ends as the run of all.
    runs: Vec<Run<K>>,
}

impl<K> Default for DepthOrder<K> {
    fn default() -> Self {
        Self { runs: Vec::new() }
    }
}

impl<K: RadixKey> DepthOrder<K> {
    pub(crate) fn bytes(&self) -> usize {
        self.runs
            .iter()
            .map(|run| bytes_of(&run.pairs) + run.sort.bytes())
            .sum()
    }

    /// Keys and indices of the Gaussians that reach some tile, nearest first, ties by index.
    pub(crate) fn pairs(&self) -> &[(K, u32)] {
        self.runs.first().map_or(&[], |run| &run.pairs)
    }

    /// Sorts the Gaussians that reach some tile: a run for each thread, then two runs into one until there is one.
    pub(crate) fn sort<T: Real<Key = K>>(&mut self, depths: &[T], covers: &[Cover]) {
        let packets = covers.len().div_ceil(rayon::current_num_threads());
        let packets = packets.max(LEAST_PACKETS);
        let count = covers.len().div_ceil(packets).max(1);
        if self.runs.len() < count {
            self.runs.resize_with(count, || Run {
                pairs: Vec::new(),
                sort: SortScratch::default(),
            });
        }
        let runs = &mut self.runs[..count];
        runs.par_iter_mut().enumerate().for_each(|(i, run)| {
            let from = (i * packets).min(covers.len());
            let past = (from + packets).min(covers.len());
            let depths = &depths[from * PACKET_SIZE..depths.len().min(past * PACKET_SIZE)];
            run.take(from * PACKET_SIZE, depths, &covers[from..past]);
            radix_sort_with(&mut run.pairs, &mut run.sort);
        });
        let mut apart = 1;
        while apart < count {
            runs.par_chunks_mut(2 * apart).for_each(|runs| {
                if let Some((left, rest)) = runs.split_first_mut()
                    && let Some(right) = rest.get(apart - 1)
                {
                    left.merge(&right.pairs);
                }
            });
            apart *= 2;
        }
    }
}

impl<K: RadixKey> Run<K> {
    /// The Gaussians that reach some tile, of those from `first` on.
    fn take<T: Real<Key = K>>(&mut self, first: usize, depths: &[T], covers: &[Cover]) {
        let pairs = stale(&mut self.pairs, depths.len());
        let (mut reached, mut index) = (0, first as u32);
        for (depths, cover) in depths.chunks(PACKET_SIZE).zip(covers) {
            for (local, depth) in depths.iter().enumerate() {
                // Overwritten by the next if it reaches nothing, which is hard for a branch to predict.
                pairs[reached] = (depth.key(), index);
                reached += usize::from(cover.reaches(local));
                index += 1;
            }
        }
        self.pairs.truncate(reached);
    }

    /// Merges a run of later Gaussians into this one.
    fn merge(&mut self, later: &[(K, u32)]) {
        let merged = self.sort.spare();
        merge_runs(&self.pairs, later, stale(merged, self.pairs.len() + later.len()));
        std::mem::swap(&mut self.pairs, merged);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_number_of_threads_makes_the_same_order() {
        let depths: Vec<f32> = (0..100_000u32)
            .map(|i| (i.wrapping_mul(2_654_435_761) >> 22) as f32)
            .collect();
        let covers: Vec<Cover> = depths
            .chunks(PACKET_SIZE)
            .map(|part| Cover::of_single_tiles(part.len(), |local| local % 3 != 0))
            .collect();
        let mut expected: Vec<(u32, u32)> = depths
            .iter()
            .zip(0u32..)
            .filter(|&(_, i)| !(i as usize % PACKET_SIZE).is_multiple_of(3))
            .map(|(depth, i)| (depth.key(), i))
            .collect();
        expected.sort_by_key(|&(key, _)| key);
        for threads in [1, 2, 3, 8] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let mut order = DepthOrder::default();
            for count in [depths.len(), 5000, depths.len(), 0] {
                pool.install(|| order.sort(&depths[..count], &covers[..count.div_ceil(PACKET_SIZE)]));
                let expected: Vec<_> = expected
                    .iter()
                    .filter(|pair| (pair.1 as usize) < count)
                    .copied()
                    .collect();
                assert_eq!(order.pairs(), expected, "{threads} threads, {count} Gaussians");
            }
        }
    }
}

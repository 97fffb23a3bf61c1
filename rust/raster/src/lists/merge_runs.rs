//! Merges two sorted runs into one, in pieces that threads make at the same time. It knows nothing of splats.

use rayon::prelude::*;

use crate::math::radix_key::RadixKey;

/// Pairs that one thread merges at a time.
const PIECE: usize = 4096;

/// How many of the first `count` pairs of the merged run are of the left one.
fn of_the_left<K: RadixKey>(left: &[(K, u32)], right: &[(K, u32)], count: usize) -> usize {
    let (mut low, mut high) = (count.saturating_sub(right.len()), count.min(left.len()));
    while low < high {
        let middle = low + (high - low) / 2;
        if left[middle].0 <= right[count - middle - 1].0 {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    low
}

/// Merges runs that are sorted by key; of equal keys those of the left run come first. `out` is as long as both.
pub(crate) fn merge_runs<K: RadixKey>(left: &[(K, u32)], right: &[(K, u32)], out: &mut [(K, u32)]) {
    out.par_chunks_mut(PIECE).enumerate().for_each(|(piece, out)| {
        let (first, past) = (piece * PIECE, piece * PIECE + out.len());
        let (i, end) = (of_the_left(left, right, first), of_the_left(left, right, past));
        merge(&left[i..end], &right[first - i..past - end], out);
    });
}

fn merge<K: RadixKey>(left: &[(K, u32)], right: &[(K, u32)], out: &mut [(K, u32)]) {
    let (mut i, mut j) = (0, 0);
    let both = left.len().min(right.len());
    let mut done = 0;
    // Which run is next is hard for a branch to predict. Neither ends before as many pairs as the shorter one has.
    while done < out.len() && i < left.len() && j < right.len() {
        let safe = (left.len() - i).min(right.len() - j).min(both);
        for place in &mut out[done..done + safe] {
            let (a, b) = (left[i], right[j]);
            let from_left = a.0 <= b.0;
            *place = if from_left { a } else { b };
            i += usize::from(from_left);
            j += usize::from(!from_left);
        }
        done += safe;
    }
    out[done..done + left.len() - i].copy_from_slice(&left[i..]);
    done += left.len() - i;
    out[done..].copy_from_slice(&right[j..]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merged_runs_are_what_a_stable_sort_makes_of_them() {
        let run = |len: u64, step: u64, first: u32| -> Vec<(u64, u32)> {
            (0..len).map(|i| i * step / 7).zip(first..).collect()
        };
        for (a, b) in [(0, 0), (0, 5), (5, 0), (1, 1), (3000, 20_000), (20_000, 9000)] {
            for (step_a, step_b) in [(1, 1), (3, 50), (50, 3), (0, 0)] {
                let (left, right) = (run(a, step_a, 0), run(b, step_b, 1 << 20));
                let mut expected = [&left[..], &right].concat();
                expected.sort_by_key(|&(key, _)| key);
                let mut out = vec![(0, 0); expected.len()];
                merge_runs(&left, &right, &mut out);
                assert_eq!(out, expected);
            }
        }
    }
}

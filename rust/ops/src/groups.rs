//! Groups of a hand's vertices, and which of a group reach furthest into an object.

use bigs_raster::Vectors;

use crate::OpsError;

/// Vertices of which those that reach furthest count: the whole hand, or a finger.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Group {
    /// How many of a frame's least distances are averaged, all of them if there are fewer.
    pub deepest: usize,
    /// Rising; `None` for all vertices.
    pub vertices: Option<Vec<usize>>,
}

/// A vertex says in so many bits to which groups it counts.
pub(crate) const MOST_GROUPS: usize = u32::BITS as usize;

/// A group of a certain hand.
#[derive(Debug)]
pub(crate) struct Deepest {
    /// How many of the vertices count, at least one.
    pub(crate) count: usize,
    vertices: Vec<usize>,
}

impl Deepest {
    /// Of a hand that has so many vertices.
    pub(crate) fn of(group: &Group, vertices: usize) -> Result<Self, OpsError> {
        let chosen = group.vertices.clone().unwrap_or_else(|| (0..vertices).collect());
        let rising = chosen.windows(2).all(|pair| pair[0] < pair[1]);
        let count = chosen.len().min(group.deepest);
        if count == 0 || !rising || chosen.last().is_some_and(|&last| last >= vertices) {
            return Err(OpsError::BadSize {
                name: "groups",
                expected: "rising vertices of the hand, at least one that counts",
                got: count,
            });
        }
        Ok(Self {
            count,
            vertices: chosen,
        })
    }

    /// The mean of the least of the hand's distances; `bit` is set for the vertices that count. Of equal distances the
    /// first are taken.
    pub(crate) fn mark<T: Vectors>(&self, distances: &[T], among: &mut [u32], bit: u32) -> T {
        // As integers, which take no branch to compare.
        let mut keys: Vec<T::Key> = self
            .vertices
            .iter()
            .map(|&vertex| distances[vertex].key())
            .collect();
        let (less, &mut last, _) = keys.select_nth_unstable(self.count - 1);
        let mut equal = self.count - less.iter().filter(|&&key| key < last).count();
        let mut sum = T::ZERO;
        for &vertex in &self.vertices {
            let key = distances[vertex].key();
            if key > last || key == last && equal == 0 {
                continue;
            }
            equal -= usize::from(key == last);
            sum += distances[vertex];
            among[vertex] |= bit;
        }
        sum / T::of(self.count as f64)
    }
}

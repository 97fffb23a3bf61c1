//! The nearest of many points, within reach.

use crate::Vec3;

/// A part with at most this many points is looked through.
const LEAF: usize = 8;

/// Points in a k-d tree.
#[derive(Clone, Debug)]
pub(crate) struct Nearest {
    /// In the tree's order, with their indices.
    points: Vec<(Vec3, usize)>,
    /// Of each inner node, whose children are 2 i + 1 and 2 i + 2: the axis that it splits, and where.
    splits: Vec<(usize, f64)>,
}

impl Nearest {
    pub(crate) fn new(points: &[Vec3]) -> Self {
        let mut tree = Self {
            points: points.iter().copied().zip(0..).collect(),
            splits: Vec::new(),
        };
        tree.split(0, 0, points.len());
        tree
    }

    fn split(&mut self, node: usize, begin: usize, end: usize) {
        if end - begin <= LEAF {
            return;
        }
        let part = &mut self.points[begin..end];
        let (mut lower, mut upper) = (part[0].0, part[0].0);
        for (point, _) in part.iter() {
            for i in 0..3 {
                lower[i] = lower[i].min(point[i]);
                upper[i] = upper[i].max(point[i]);
            }
        }
        let extent = |i: usize| upper[i] - lower[i];
        let axis = (1..3).fold(0, |best, i| if extent(i) > extent(best) { i } else { best });
        let half = part.len() / 2;
        part.select_nth_unstable_by(half, |a, b| a.0[axis].total_cmp(&b.0[axis]));
        let place = part[half].0[axis];
        if self.splits.len() <= node {
            self.splits.resize(node + 1, (0, 0.0));
        }
        self.splits[node] = (axis, place);
        self.split(2 * node + 1, begin, begin + half);
        self.split(2 * node + 2, begin + half, end);
    }

    /// Index of the point that is nearest to a place, if it is nearer than `reach`.
    pub(crate) fn within(&self, place: Vec3, reach: f64) -> Option<usize> {
        self.nearer(place, (reach * reach, None)).1
    }

    /// Squared distance and index of the nearest point, or `best` if none is nearer than that.
    pub(crate) fn nearer(&self, place: Vec3, mut best: (f64, Option<usize>)) -> (f64, Option<usize>) {
        self.look((0, 0, self.points.len()), place, [0.0; 3], &mut best);
        best
    }

    /// `beyond` is how far the place is out of the node's part of space along each axis, squared.
    fn look(
        &self,
        (node, begin, end): (usize, usize, usize),
        place: Vec3,
        beyond: Vec3,
        best: &mut (f64, Option<usize>),
    ) {
        if end - begin <= LEAF {
            for (point, index) in &self.points[begin..end] {
                let squared = squared_distance(*point, place);
                if squared < best.0 {
                    *best = (squared, Some(*index));
                }
            }
            return;
        }
        let (axis, split) = self.splits[node];
        let away = place[axis] - split;
        let half = begin + (end - begin) / 2;
        let (lower, upper) = ((2 * node + 1, begin, half), (2 * node + 2, half, end));
        let (first, second) = if away < 0.0 {
            (lower, upper)
        } else {
            (upper, lower)
        };
        self.look(first, place, beyond, best);
        let mut beyond = beyond;
        beyond[axis] = away * away;
        if beyond[0] + beyond[1] + beyond[2] < best.0 {
            self.look(second, place, beyond, best);
        }
    }
}

/// Of two places.
pub(crate) fn squared_distance(a: Vec3, b: Vec3) -> f64 {
    let away = [0, 1, 2].map(|i| a[i] - b[i]);
    away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
}

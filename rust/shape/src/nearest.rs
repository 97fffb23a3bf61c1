//! The nearest of many points, within reach.

use crate::Vec3;

/// A part with at most this many points is looked through.
const LEAF: usize = 8;

/// Points in a tree of boxes, each of which is halved across its longest side.
#[derive(Clone, Debug)]
pub(crate) struct Nearest {
    /// In the tree's order, with their indices.
    points: Vec<(Vec3, usize)>,
    /// The smallest box around the points of each node, whose children are 2 i + 1 and 2 i + 2.
    boxes: Vec<Box3>,
}

/// Part of the points, and the node that it belongs to.
#[derive(Clone, Copy)]
struct Part {
    node: usize,
    begin: usize,
    end: usize,
}

impl Part {
    fn halves(self) -> [Self; 2] {
        let half = self.begin + (self.end - self.begin) / 2;
        let child = |i, begin, end| Self {
            node: 2 * self.node + i,
            begin,
            end,
        };
        [child(1, self.begin, half), child(2, half, self.end)]
    }

    fn is_leaf(self) -> bool {
        self.end - self.begin <= LEAF
    }
}

impl Nearest {
    pub(crate) fn new(points: &[Vec3]) -> Self {
        let mut tree = Self {
            points: points.iter().copied().zip(0..).collect(),
            boxes: Vec::new(),
        };
        tree.build(tree.whole());
        tree
    }

    fn whole(&self) -> Part {
        Part {
            node: 0,
            begin: 0,
            end: self.points.len(),
        }
    }

    fn build(&mut self, part: Part) {
        let points = &mut self.points[part.begin..part.end];
        let around = Box3::around(points.iter().map(|(point, _)| point));
        if self.boxes.len() <= part.node {
            self.boxes.resize(part.node + 1, Box3::NOTHING);
        }
        self.boxes[part.node] = around;
        if part.is_leaf() {
            return;
        }
        let axis = around.longest_side();
        points.select_nth_unstable_by(points.len() / 2, |a, b| a.0[axis].total_cmp(&b.0[axis]));
        for half in part.halves() {
            self.build(half);
        }
    }

    /// Index of the point that is nearest to a place, if it is nearer than `reach`.
    pub(crate) fn within(&self, place: Vec3, reach: f64) -> Option<usize> {
        self.nearer(place, (reach * reach, None)).1
    }

    /// Squared distance and index of the nearest point, or `best` if none is nearer than that.
    pub(crate) fn nearer(&self, place: Vec3, mut best: (f64, Option<usize>)) -> (f64, Option<usize>) {
        self.look(self.whole(), place, &mut best);
        best
    }

    fn look(&self, part: Part, place: Vec3, best: &mut (f64, Option<usize>)) {
        if part.is_leaf() {
            for (point, index) in &self.points[part.begin..part.end] {
                let squared = squared_distance(*point, place);
                if squared < best.0 {
                    *best = (squared, Some(*index));
                }
            }
            return;
        }
        let mut halves = part
            .halves()
            .map(|half| (self.boxes[half.node].squared_distance(place), half));
        if halves[1].0 < halves[0].0 {
            halves.swap(0, 1);
        }
        for (squared, half) in halves {
            if squared < best.0 {
                self.look(half, place, best);
            }
        }
    }
}

/// A box along the axes.
#[derive(Clone, Copy, Debug)]
struct Box3 {
    lower: Vec3,
    upper: Vec3,
}

impl Box3 {
    const NOTHING: Self = Self {
        lower: [f64::INFINITY; 3],
        upper: [f64::NEG_INFINITY; 3],
    };

    fn around<'a>(points: impl Iterator<Item = &'a Vec3>) -> Self {
        points.fold(Self::NOTHING, |found, point| Self {
            lower: [0, 1, 2].map(|i| found.lower[i].min(point[i])),
            upper: [0, 1, 2].map(|i| found.upper[i].max(point[i])),
        })
    }

    fn longest_side(&self) -> usize {
        let side = |i: usize| self.upper[i] - self.lower[i];
        (1..3).fold(0, |best, i| if side(i) > side(best) { i } else { best })
    }

    /// From a place to the nearest of the box; rounded as those of its points are, so never above them.
    fn squared_distance(&self, place: Vec3) -> f64 {
        let away = [0, 1, 2].map(|i| (self.lower[i] - place[i]).max(place[i] - self.upper[i]).max(0.0));
        away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
    }
}

/// Of two places.
pub(crate) fn squared_distance(a: Vec3, b: Vec3) -> f64 {
    let away = [0, 1, 2].map(|i| a[i] - b[i]);
    away[0] * away[0] + away[1] * away[1] + away[2] * away[2]
}

//! The edges of triangles, and which way each triangle faces.

use crate::OpsError;
use bigs_raster::filled_with;

use super::bits::Point;

/// Edges in the order of their vertices, each with the triangles at it.
pub(super) struct Edges {
    each: Vec<Edge>,
    triangles: Vec<Neighbour>,
}

/// An edge's vertices, the lower index first, and where its triangles end in the list.
struct Edge {
    ends: [usize; 2],
    until: usize,
}

/// A triangle at an edge.
#[derive(Clone, Copy)]
struct Neighbour {
    face: usize,
    /// 1 if the triangle passes the edge from its first vertex to its second one, otherwise -1.
    way: i8,
}

/// The triangles at an edge, in a frame.
pub(super) struct Beside {
    /// How many triangles begin on the right of the edge as one walks down the picture along it from its first vertex,
    /// less those that end there.
    pub(super) net: i32,
    /// The side of it on which all triangles lie: 1 if to the right in that sense, -1 if to the left, 0 if they lie on both.
    pub(super) side: i32,
}

impl Edges {
    /// The edges of triangles between `vertices` vertices.
    ///
    /// # Errors
    /// No memory.
    pub(super) fn of(faces: &[[usize; 3]], vertices: usize) -> Result<Self, OpsError> {
        // By their first vertices, of which each has few: much less work than to sort them all.
        let mut ends_at = filled_with("edges", 0, &[vertices + 1])?;
        for_each_side(faces, |[first, _], _| ends_at[first + 1] += 1);
        for vertex in 0..vertices {
            ends_at[vertex + 1] += ends_at[vertex];
        }
        let mut next = ends_at.clone();
        let mut sorted = filled_with("edges", (0, Neighbour { face: 0, way: 0 }), &[faces.len(), 3])?;
        for_each_side(faces, |[first, second], neighbour| {
            sorted[next[first]] = (second, neighbour);
            next[first] += 1;
        });
        let mut each = Vec::with_capacity(sorted.len() / 2);
        for first in 0..vertices {
            let begin = ends_at[first];
            let of_vertex = &mut sorted[begin..ends_at[first + 1]];
            of_vertex.sort_by_key(|&(second, _)| second);
            let mut until = begin;
            for of_edge in of_vertex.chunk_by(|one, other| one.0 == other.0) {
                until += of_edge.len();
                each.push(Edge {
                    ends: [first, of_edge[0].0],
                    until,
                });
            }
        }
        Ok(Self {
            each,
            triangles: sorted.into_iter().map(|(_, neighbour)| neighbour).collect(),
        })
    }

    /// Each edge's ends, and what is beside it, by the triangles' `facings`.
    pub(super) fn beside<'a>(&'a self, facings: &'a [i8]) -> impl Iterator<Item = ([usize; 2], Beside)> + 'a {
        let mut begin = 0;
        self.each.iter().map(move |edge| {
            let triangles = &self.triangles[begin..edge.until];
            begin = edge.until;
            let (mut net, mut all) = (0, 0);
            for neighbour in triangles {
                let side = i32::from(facings[neighbour.face] * neighbour.way);
                net += side;
                all += side.abs();
            }
            let side = if net.abs() == all { net.signum() } else { 0 };
            (edge.ends, Beside { net, side })
        })
    }
}

/// Calls `visit` with every side of every triangle: its vertices, the lower index first, and the triangle.
fn for_each_side(faces: &[[usize; 3]], mut visit: impl FnMut([usize; 2], Neighbour)) {
    for (face, &[a, b, c]) in faces.iter().enumerate() {
        for [from, to] in [[a, b], [b, c], [c, a]] {
            let way = if from < to { 1 } else { -1 };
            visit([from.min(to), from.max(to)], Neighbour { face, way });
        }
    }
}

/// Which way each triangle faces: 1 or -1, and 0 if it is seen from its edge or not at all. Its sides then agree on where it
/// lies whatever is rounded.
pub(super) fn facings(faces: &[[usize; 3]], seen: &[Option<Point>]) -> Vec<i8> {
    faces
        .iter()
        .map(|face| {
            let [Some(a), Some(b), Some(c)] = face.map(|vertex| seen[vertex]) else {
                return 0;
            };
            let turn = (b[1] - a[1]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[1] - a[1]);
            i8::from(turn > 0.0) - i8::from(turn < 0.0)
        })
        .collect()
}

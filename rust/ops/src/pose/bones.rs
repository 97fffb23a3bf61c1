//! A bone as sixteen numbers that a Gaussian's weights blend: its affine rows and the quaternion of its rotation.

use bigs_raster::Real;

/// Twelve of the affine transform, row by row, then four of the quaternion.
pub(crate) type Bone<T> = [T; 16];

/// 1 + vec(R) · these is the diagonal of 4 q qᵀ for the quaternion q of R, and without 1 the rest of it: for each of
/// the sixteen places the entries of R with their signs.
const OUTER: [&[(usize, f64)]; 16] = [
    &[(0, 1.0), (4, 1.0), (8, 1.0)],
    &[(7, 1.0), (5, -1.0)],
    &[(2, 1.0), (6, -1.0)],
    &[(3, 1.0), (1, -1.0)],
    &[(7, 1.0), (5, -1.0)],
    &[(0, 1.0), (4, -1.0), (8, -1.0)],
    &[(1, 1.0), (3, 1.0)],
    &[(2, 1.0), (6, 1.0)],
    &[(2, 1.0), (6, -1.0)],
    &[(1, 1.0), (3, 1.0)],
    &[(0, -1.0), (4, 1.0), (8, -1.0)],
    &[(5, 1.0), (7, 1.0)],
    &[(3, 1.0), (1, -1.0)],
    &[(2, 1.0), (6, 1.0)],
    &[(5, 1.0), (7, 1.0)],
    &[(0, -1.0), (4, -1.0), (8, 1.0)],
];

/// Where vec(R) lies among the affine rows.
const fn linear(entry: usize) -> usize {
    entry / 3 * 4 + entry % 3
}

/// The quaternion of a bone's rotation, and what its gradient needs.
#[derive(Clone, Copy)]
pub(crate) struct Turn<T> {
    unit: [T; 4],
    /// The row of q qᵀ that it was read from: that of the largest part.
    row: usize,
    inverse_length: T,
    /// −1 where the quaternion was turned to the side of the first bone's.
    sign: T,
}

impl<T: Real> Turn<T> {
    /// Of affine rows, on the side of `first`, whose sign is free.
    fn of(affine: &[T], first: Option<[T; 4]>) -> Self {
        let outer = |place: usize| {
            let one = if place.is_multiple_of(5) { T::ONE } else { T::ZERO };
            OUTER[place].iter().fold(one, |sum, &(entry, sign)| {
                sum + T::of(sign) * affine[linear(entry)]
            })
        };
        let mut row = 0;
        for other in 1..4 {
            if outer(5 * other) > outer(5 * row) {
                row = other;
            }
        }
        let values: [T; 4] = std::array::from_fn(|i| outer(4 * row + i));
        let length = dot(values, values).sqrt().greater(T::of(1e-12));
        let inverse_length = T::ONE / length;
        let unit = values.map(|v| v * inverse_length);
        let sign = match first {
            Some(first) if dot(unit, first) < T::ZERO => -T::ONE,
            _ => T::ONE,
        };
        Self {
            unit,
            row,
            inverse_length,
            sign,
        }
    }

    /// The gradient of the rotation's nine entries from that of the quaternion.
    fn vjp(&self, v: [T; 4]) -> [T; 9] {
        let v = v.map(|v| self.sign * v);
        let radial = dot(self.unit, v);
        let mut out = [T::ZERO; 9];
        for i in 0..4 {
            let v_row = self.inverse_length * (v[i] - self.unit[i] * radial);
            for &(entry, sign) in OUTER[4 * self.row + i] {
                out[entry] += T::of(sign) * v_row;
            }
        }
        out
    }
}

fn dot<T: Real>(a: [T; 4], b: [T; 4]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
}

/// The bones of all frames, `count` a frame.
pub(crate) struct Bones<T> {
    pub(crate) count: usize,
    records: Vec<Bone<T>>,
    turns: Vec<Turn<T>>,
}

impl<T: Real> Bones<T> {
    /// Reads matrices of `size` entries (12 or 16); without `turned` quaternions stay zero.
    pub(crate) fn new(matrices: &[T], count: usize, size: usize, turned: bool) -> Self {
        let mut records = Vec::with_capacity(matrices.len() / size);
        let mut turns = Vec::new();
        let mut first = None;
        for (index, matrix) in matrices.chunks_exact(size).enumerate() {
            let mut record = [T::ZERO; 16];
            record[..12].copy_from_slice(&matrix[..12]);
            if turned {
                let turn = Turn::of(matrix, first.filter(|_| index % count != 0));
                if index % count == 0 {
                    first = Some(turn.unit);
                }
                record[12..].copy_from_slice(&turn.unit.map(|part| turn.sign * part));
                turns.push(turn);
            }
            records.push(record);
        }
        Self {
            count,
            records,
            turns,
        }
    }

    pub(crate) fn of_frame(&self, frame: usize) -> &[Bone<T>] {
        &self.records[frame * self.count..][..self.count]
    }

    /// Gradients of the matrices from those of the records.
    pub(crate) fn vjp(&self, v_records: &[Bone<T>], size: usize) -> Vec<T> {
        let mut out = vec![T::ZERO; v_records.len() * size];
        for (index, (v, matrix)) in v_records.iter().zip(out.chunks_exact_mut(size)).enumerate() {
            matrix[..12].copy_from_slice(&v[..12]);
            if let Some(turn) = self.turns.get(index) {
                let v_turn = turn.vjp([v[12], v[13], v[14], v[15]]);
                for (entry, v) in v_turn.into_iter().enumerate() {
                    matrix[linear(entry)] += v;
                }
            }
        }
        out
    }
}

use std::f64::consts::TAU;

use crate::Vec3;

/// Which motions leave an object the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The reflection in a plane.
    Plane,
    /// All turns about an axis.
    Axis,
}

/// A mirror plane, or an axis of revolution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Symmetry {
    /// Which of the two.
    pub kind: Kind,
    /// On the plane or axis.
    pub point: Vec3,
    /// Unit: the plane's normal, the axis's direction.
    pub direction: Vec3,
}

impl Symmetry {
    /// What carries directions: a reflection, or turns by whole multiples of a `turns`-th of the circle.
    pub(crate) fn matrices(&self, turns: usize) -> Vec<[Vec3; 3]> {
        match self.kind {
            Kind::Plane => vec![self.reflection()],
            Kind::Axis => (1..turns)
                .map(|k| self.turn(TAU * k as f64 / turns as f64))
                .collect(),
        }
    }

    /// The symmetry moved by x, lengths as shares of `size`: a plane by x₁ along its normal, an axis by x₀ and x₁ across;
    /// either turned by x₂ and x₃.
    pub(crate) fn moved(&self, x: [f64; 4], size: f64) -> Self {
        let d = self.direction;
        let [first, second] = across(d);
        let turned = [0, 1, 2].map(|i| d[i] + x[2] * first[i] + x[3] * second[i]);
        let shift = match self.kind {
            Kind::Plane => d.map(|along| x[1] * along),
            Kind::Axis => [0, 1, 2].map(|i| x[0] * first[i] + x[1] * second[i]),
        };
        let length = dot(turned, turned).sqrt();
        Self {
            kind: self.kind,
            point: [0, 1, 2].map(|i| self.point[i] + size * shift[i]),
            direction: turned.map(|along| along / length),
        }
    }

    /// How a carried point's part along `normal` changes with the symmetry's point and with its direction; `arm` leads
    /// from that point to the one that is carried, by the matrix `index` of `turns`.
    pub(crate) fn slopes(&self, index: usize, turns: usize, arm: Vec3, normal: Vec3) -> [Vec3; 2] {
        let d = self.direction;
        let (along_arm, along_normal) = (dot(d, arm), dot(d, normal));
        let mixed = [0, 1, 2].map(|i| along_arm * normal[i] + along_normal * arm[i]);
        match self.kind {
            Kind::Plane => [d.map(|x| 2.0 * along_normal * x), mixed.map(|x| -2.0 * x)],
            Kind::Axis => {
                let (sine, cosine) = (TAU * (index + 1) as f64 / turns as f64).sin_cos();
                let around = cross(arm, normal);
                // The normal turned back.
                let back = cross(normal, d);
                let by_point = [0, 1, 2].map(|i| {
                    normal[i] - (cosine * normal[i] + sine * back[i] + (1.0 - cosine) * along_normal * d[i])
                });
                [
                    by_point,
                    [0, 1, 2].map(|i| sine * around[i] + (1.0 - cosine) * mixed[i]),
                ]
            }
        }
    }

    fn reflection(&self) -> [Vec3; 3] {
        let d = self.direction;
        [0, 1, 2].map(|i| [0, 1, 2].map(|j| f64::from(i == j) - 2.0 * d[i] * d[j]))
    }

    fn turn(&self, angle: f64) -> [Vec3; 3] {
        let d = self.direction;
        let (sine, cosine) = angle.sin_cos();
        let cross = [[0.0, -d[2], d[1]], [d[2], 0.0, -d[0]], [-d[1], d[0], 0.0]];
        [0, 1, 2].map(|i| {
            [0, 1, 2].map(|j| cosine * f64::from(i == j) + sine * cross[i][j] + (1.0 - cosine) * d[i] * d[j])
        })
    }

    /// Where a point is carried by one of the matrices.
    pub(crate) fn carried(&self, matrix: &[Vec3; 3], point: Vec3) -> Vec3 {
        let turned = times(matrix, [0, 1, 2].map(|i| point[i] - self.point[i]));
        [0, 1, 2].map(|i| turned[i] + self.point[i])
    }
}

pub(crate) fn times(matrix: &[Vec3; 3], v: Vec3) -> Vec3 {
    matrix.map(|row| dot(row, v))
}

pub(crate) fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// Two unit vectors at right angles to a unit direction and to each other.
pub(crate) fn across(d: Vec3) -> [Vec3; 2] {
    let least = (1..3).fold(0, |least, i| if d[i].abs() < d[least].abs() { i } else { least });
    let mut helper = [0.0; 3];
    helper[least] = 1.0;
    let first = cross(d, helper);
    let length = dot(first, first).sqrt();
    let first = first.map(|x| x / length);
    [first, cross(d, first)]
}

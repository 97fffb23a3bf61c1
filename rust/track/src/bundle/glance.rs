//! One observation's part of the normal equations.

use crate::bundle::scene::{Place, Scene};

/// An observation's derivatives. Rows of derivatives are those of the pixel, right and down.
pub(crate) struct Glance {
    /// From the object's origin to the point, along the camera's axes.
    pub(crate) arm: [f64; 3],
    /// Right and down, as shares of the depth.
    pub(crate) ray: [f64; 2],
    /// By the place in the camera's frame.
    pub(crate) slope: [[f64; 3]; 2],
    /// Cauchy's second derivatives by the pixel (xx, xy, yy), halved.
    pub(crate) weight: [f64; 3],
    /// Its first derivatives, halved.
    pub(crate) pull: [f64; 2],
}

/// Second derivatives (xx, xy, yy) and first ones of Cauchy's loss by the pixel, halved.
#[inline(always)]
fn pulled([xx, xy, yy]: [f64; 3], [x, y]: [f64; 2], sigma: f64) -> ([f64; 3], [f64; 2]) {
    let (right, down) = (xx * x + xy * y, xy * x + yy * y);
    let weight = 1.0 / (sigma * sigma + right * x + down * y);
    (
        [weight * xx, weight * xy, weight * yy],
        [weight * right, weight * down],
    )
}

/// How a pixel changes with its place in the camera's frame.
#[inline(always)]
fn slope(place: &Place, focal: [f64; 2]) -> [[f64; 3]; 2] {
    let per_depth = 1.0 / place.depth;
    let (wide, high) = (focal[0] * per_depth, focal[1] * per_depth);
    [
        [wide, 0.0, -place.ray[0] * wide],
        [0.0, high, -place.ray[1] * high],
    ]
}

impl Glance {
    #[inline(always)]
    pub(crate) fn new(
        scene: &Scene<'_>,
        (frame, point): (usize, usize),
        pixel: [f64; 2],
        precision: [f64; 3],
    ) -> Self {
        let place = scene.place(frame, point, pixel);
        let (weight, pull) = pulled(precision, place.off, scene.sigma);
        Self {
            arm: place.arm,
            ray: place.ray,
            slope: slope(&place, scene.focal),
            weight,
            pull,
        }
    }

    /// Weighted rows: second derivatives times `rows`.
    #[inline(always)]
    pub(crate) fn weighted<const N: usize>(&self, rows: &[[f64; N]; 2]) -> [[f64; N]; 2] {
        let [xx, xy, yy] = self.weight;
        [
            std::array::from_fn(|j| xx * rows[0][j] + xy * rows[1][j]),
            std::array::from_fn(|j| xy * rows[0][j] + yy * rows[1][j]),
        ]
    }

    /// How the pixel changes with the point, which `turn` turns.
    #[inline(always)]
    pub(crate) fn by_point(&self, turn: &[f64; 9]) -> [[f64; 3]; 2] {
        let [[wide, _, far_x], [_, high, far_y]] = self.slope;
        [
            std::array::from_fn(|j| wide * turn[j] + far_x * turn[6 + j]),
            std::array::from_fn(|j| high * turn[3 + j] + far_y * turn[6 + j]),
        ]
    }

    /// How the pixel changes with the pose: turn, then shift.
    #[inline(always)]
    pub(crate) fn by_pose(&self) -> [[f64; 6]; 2] {
        self.slope.map(|row| {
            let [a, b, c] = cross(self.arm, row);
            [a, b, c, row[0], row[1], row[2]]
        })
    }
}

#[inline(always)]
pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

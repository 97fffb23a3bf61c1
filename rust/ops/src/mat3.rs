//! Three by three matrices and rotation vectors.

use bigs_raster::Real;

pub(crate) type Vec3<T> = [T; 3];
pub(crate) type Mat3<T> = [[T; 3]; 3];

pub(crate) fn matrix<T: Real>(flat: &[T; 9]) -> Mat3<T> {
    let [a, b, c, d, e, f, g, h, i] = *flat;
    [[a, b, c], [d, e, f], [g, h, i]]
}

pub(crate) fn flat<T: Real>(m: &Mat3<T>) -> [T; 9] {
    let [[a, b, c], [d, e, f], [g, h, i]] = *m;
    [a, b, c, d, e, f, g, h, i]
}

pub(crate) fn product<T: Real>(a: &Mat3<T>, b: &Mat3<T>) -> Mat3<T> {
    a.map(|row| [0, 1, 2].map(|j| row[0] * b[0][j] + row[1] * b[1][j] + row[2] * b[2][j]))
}

pub(crate) fn transposed<T: Real>(a: &Mat3<T>) -> Mat3<T> {
    [0, 1, 2].map(|i| [a[0][i], a[1][i], a[2][i]])
}

pub(crate) fn apply<T: Real>(a: &Mat3<T>, v: Vec3<T>) -> Vec3<T> {
    a.map(|row| dot(row, v))
}

pub(crate) fn dot<T: Real>(a: Vec3<T>, b: Vec3<T>) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn scaled<T: Real>(factor: T, v: Vec3<T>) -> Vec3<T> {
    v.map(|value| factor * value)
}

pub(crate) fn plus<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(crate) fn minus<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn add<T: Real>(sum: &mut Vec3<T>, v: Vec3<T>) {
    *sum = plus(*sum, v);
}

/// Adds factor · a ⊗ b.
pub(crate) fn add_outer<T: Real>(sum: &mut Mat3<T>, factor: T, a: Vec3<T>, b: Vec3<T>) {
    for i in 0..3 {
        for j in 0..3 {
            sum[i][j] += factor * a[i] * b[j];
        }
    }
}

/// Below this angle quotients of small differences are read off their series.
const SMALL: f64 = 0.05;

/// sin θ / θ and (1 − cos θ) / θ², and the derivatives of both by θ over θ.
fn bends(squared: f64) -> [f64; 4] {
    let angle = squared.sqrt();
    if angle < SMALL {
        let s = squared;
        return [
            1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0)),
            0.5 - s / 24.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0)),
            -1.0 / 3.0 + s / 30.0 * (1.0 - s / 28.0 * (1.0 - s / 54.0)),
            -1.0 / 12.0 + s / 180.0 * (1.0 - s / 37.333_333_333_333_336 * (1.0 - s / 67.5)),
        ];
    }
    let (sin, cos) = angle.sin_cos();
    let (a, b) = (sin / angle, (1.0 - cos) / squared);
    [a, b, (cos - a) / squared, (a - 2.0 * b) / squared]
}

/// The matrix of a rotation vector in radians (Rodrigues' formula).
pub(crate) fn rotation<T: Real>(vector: Vec3<T>) -> Mat3<T> {
    let [x, y, z] = vector.map(T::as_f64);
    let [a, b, ..] = bends(x * x + y * y + z * z);
    let diagonal = |p: f64, q: f64| 1.0 - b * (p * p + q * q);
    [
        [diagonal(y, z), b * x * y - a * z, b * x * z + a * y],
        [b * x * y + a * z, diagonal(x, z), b * y * z - a * x],
        [b * x * z - a * y, b * y * z + a * x, diagonal(x, y)],
    ]
    .map(|row| row.map(T::of))
}

/// The gradient of a rotation vector from that of its matrix.
pub(crate) fn rotation_vjp<T: Real>(vector: Vec3<T>, v: &Mat3<T>) -> Vec3<T> {
    let [x, y, z] = vector.map(T::as_f64);
    let v = flat(v).map(T::as_f64);
    let [a, b, da, db] = bends(x * x + y * y + z * z);
    // Of the two factors, which depend on the length alone.
    let (px, py, pz) = (v[7] - v[5], v[2] - v[6], v[3] - v[1]);
    let v_a = x * px + y * py + z * pz;
    let (xy, xz, yz) = (v[1] + v[3], v[2] + v[6], v[5] + v[7]);
    let v_b = x * y * xy + x * z * xz + y * z * yz
        - v[0] * (y * y + z * z)
        - v[4] * (x * x + z * z)
        - v[8] * (x * x + y * y);
    let along = v_a * da + v_b * db;
    [
        x * along + a * px + b * (y * xy + z * xz - 2.0 * x * (v[4] + v[8])),
        y * along + a * py + b * (x * xy + z * yz - 2.0 * y * (v[0] + v[8])),
        z * along + a * pz + b * (x * xz + y * yz - 2.0 * z * (v[0] + v[4])),
    ]
    .map(T::of)
}

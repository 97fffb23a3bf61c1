//! The real spherical harmonics to degree 3, and their derivatives.

use crate::math::real::Real;

/// √(1 / 4π)
const BAND_0: f64 = 0.282_094_791_773_878_14;
/// √(3 / 4π)
const BAND_1: f64 = 0.488_602_511_902_919_9;
/// √(15 / 4π), half of it, and √(5 / 16π) times 3 and 1
const BAND_2: [f64; 4] = [
    1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
    0.946_174_695_757_560_1,
    0.315_391_565_252_520_05,
];
/// √(35 / 32π), √(105 / 4π) and half of it, √(21 / 32π) times 5 and 1, √(7 / 16π) times 5 and 3
const BAND_3: [f64; 7] = [
    0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    1.445_305_721_320_277,
    2.285_228_997_322_329,
    0.457_045_799_464_465_8,
    1.865_881_662_950_577,
    1.119_528_997_770_346,
];

/// The first B basis functions at a unit vector.
#[inline(always)]
pub(crate) fn basis<T: Real, const B: usize>([x, y, z]: [T; 3]) -> [T; B] {
    let mut out = [T::ZERO; B];
    out[0] = T::of(BAND_0);
    if B > 1 {
        let a = T::of(BAND_1);
        out[1] = -a * y;
        out[2] = a * z;
        out[3] = -a * x;
    }
    if B > 4 {
        let [a, b, c, d] = BAND_2.map(T::of);
        out[4] = a * x * y;
        out[5] = -a * y * z;
        out[6] = c * z * z - d;
        out[7] = -a * x * z;
        out[8] = b * (x * x - y * y);
    }
    if B > 9 {
        let [a, b, c, d, e, f, g] = BAND_3.map(T::of);
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let three = T::of(3.0);
        out[9] = -a * y * (three * xx - yy);
        out[10] = b * x * y * z;
        out[11] = y * (e - d * zz);
        out[12] = z * (f * zz - g);
        out[13] = x * (e - d * zz);
        out[14] = c * z * (xx - yy);
        out[15] = -a * x * (xx - three * yy);
    }
    out
}

/// The vjp of [`basis`], as if its polynomials were meant everywhere; only the part along the sphere counts.
#[inline(always)]
pub(crate) fn basis_vjp<T: Real, const B: usize>([x, y, z]: [T; 3], v: &[T; B]) -> [T; 3] {
    let mut out = [T::ZERO; 3];
    let two = T::of(2.0);
    if B > 1 {
        let a = T::of(BAND_1);
        out = [-a * v[3], -a * v[1], a * v[2]];
    }
    if B > 4 {
        let [a, b, c, _] = BAND_2.map(T::of);
        out[0] += a * (y * v[4] - z * v[7]) + two * b * x * v[8];
        out[1] += a * (x * v[4] - z * v[5]) - two * b * y * v[8];
        out[2] += two * c * z * v[6] - a * (y * v[5] + x * v[7]);
    }
    if B > 9 {
        let [a, b, c, d, e, f, g] = BAND_3.map(T::of);
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (three, six) = (T::of(3.0), T::of(6.0));
        let (flat, sector) = (e - d * zz, three * a * (xx - yy));
        out[0] += b * y * z * v[10] + flat * v[13] + two * c * x * z * v[14]
            - six * a * x * y * v[9]
            - sector * v[15];
        out[1] += b * x * z * v[10] + flat * v[11] - two * c * y * z * v[14] - sector * v[9]
            + six * a * x * y * v[15];
        out[2] += b * x * y * v[10] + c * (xx - yy) * v[14] + (three * f * zz - g) * v[12]
            - two * d * z * (y * v[11] + x * v[13]);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points and weights that integrate polynomials of degree 7 over the sphere: Gauss in z, even steps around.
    fn quadrature() -> Vec<([f64; 3], f64)> {
        let nodes: [(f64, f64); 4] = [
            (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
            (-0.861_136_311_594_052_6, 0.347_854_845_137_453_9),
        ];
        let around = 8;
        let step = std::f64::consts::TAU / f64::from(around);
        nodes
            .iter()
            .flat_map(|&(z, weight)| {
                (0..around).map(move |k| {
                    let (angle, ring) = (step * f64::from(k), (1.0 - z * z).sqrt());
                    ([ring * angle.cos(), ring * angle.sin(), z], weight * step)
                })
            })
            .collect()
    }

    #[test]
    fn the_basis_is_orthonormal() {
        for i in 0..16 {
            for j in 0..16 {
                let product: f64 = quadrature()
                    .iter()
                    .map(|&(point, weight)| {
                        let values = basis::<f64, 16>(point);
                        weight * values[i] * values[j]
                    })
                    .sum();
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((product - expected).abs() < 1e-12, "{i} {j}: {product}");
            }
        }
    }

    #[test]
    fn signs_are_those_of_gaussian_splatting() {
        // Condon-Shortley phase: odd orders are negative along their axis.
        let [along_x, along_y, along_z] =
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(basis::<f64, 16>);
        assert!(along_y[1] < 0.0 && along_z[2] > 0.0 && along_x[3] < 0.0);
        assert!(along_z[6] > 0.0 && along_x[8] > 0.0 && along_z[12] > 0.0);
        assert!(along_y[9] > 0.0 && along_x[15] < 0.0 && along_x[13] > 0.0);
        let diagonal = basis::<f64, 16>([1.0 / 3f64.sqrt(); 3]);
        assert!(diagonal[4] > 0.0 && diagonal[5] < 0.0 && diagonal[7] < 0.0 && diagonal[10] > 0.0);
    }
}

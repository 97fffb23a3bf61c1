//! Scenes and a naive renderer for the integration tests.
#![allow(dead_code, unreachable_pub)]

use bigs_raster::{Camera, CameraModel, Gaussians, Intrinsics, RasterSettings, Scalar};

/// xorshift64*: random numbers without a dependency.
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let bits = self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 11;
        low + (high - low) * bits as f64 / (1u64 << 53) as f64
    }
}

/// Owned Gaussians.
#[derive(Clone)]
pub struct Scene<T> {
    pub means: Vec<[T; 3]>,
    pub quats: Vec<[T; 4]>,
    pub scales: Vec<[T; 3]>,
    pub opacities: Vec<T>,
    pub colors: Vec<T>,
    pub channels: usize,
}

impl<T: Scalar> Scene<T> {
    pub fn random(n: usize, channels: usize, seed: u64) -> Self {
        let mut r = Random::new(seed);
        let mut next = |low: f64, high: f64| T::of(r.uniform(low, high));
        Self {
            means: (0..n)
                .map(|_| [next(-0.6, 0.6), next(-0.5, 0.5), next(0.8, 1.6)])
                .collect(),
            quats: (0..n).map(|_| std::array::from_fn(|_| next(-1.0, 1.0))).collect(),
            scales: (0..n)
                .map(|_| std::array::from_fn(|_| next(0.01, 0.12)))
                .collect(),
            opacities: (0..n).map(|_| next(0.1, 0.95)).collect(),
            colors: (0..n * channels).map(|_| next(0.0, 1.0)).collect(),
            channels,
        }
    }

    pub fn view(&self) -> Gaussians<'_, T> {
        Gaussians::new(
            &self.means,
            &self.quats,
            &self.scales,
            &self.opacities,
            &self.colors,
            self.channels,
        )
        .expect("a scene that can be rendered")
    }
}

pub const VIEWMAT: [[f64; 4]; 4] = [
    [0.96, 0.0, 0.28, -0.2],
    [0.05, 1.0, 0.0, 0.03],
    [-0.28, 0.0, 0.96, 0.1],
    [0.0, 0.0, 0.0, 1.0],
];

pub fn intrinsics(width: usize, height: usize) -> [f64; 4] {
    let f = 1.1 * width as f64;
    [f, 1.05 * f, 0.48 * width as f64, 0.53 * height as f64]
}

pub fn camera<T: Scalar>(viewmat: [[f64; 4]; 4], width: usize, height: usize) -> Camera<T> {
    let [fx, fy, cx, cy] = intrinsics(width, height).map(T::of);
    Camera::new(
        viewmat.map(|row| row.map(T::of)),
        Intrinsics { fx, fy, cx, cy },
        width,
        height,
    )
    .expect("a camera")
}

/// Every pixel against every Gaussian, in f64, from the formulas: colours (rows, columns, channels) and alphas.
pub fn naive(
    scene: &Scene<f64>,
    viewmat: [[f64; 4]; 4],
    width: usize,
    height: usize,
    settings: &RasterSettings,
) -> (Vec<f64>, Vec<f64>) {
    naive_with(CameraModel::Pinhole, scene, viewmat, width, height, settings)
}

/// The same through either kind of camera.
pub fn naive_with(
    model: CameraModel,
    scene: &Scene<f64>,
    viewmat: [[f64; 4]; 4],
    width: usize,
    height: usize,
    settings: &RasterSettings,
) -> (Vec<f64>, Vec<f64>) {
    let [fx, fy, cx, cy] = intrinsics(width, height);
    struct Flat {
        centre: [f64; 2],
        inverse: [f64; 3],
        depth: f64,
        id: usize,
    }
    let mut flats: Vec<Flat> = (0..scene.means.len())
        .map(|id| {
            let m = scene.means[id];
            let p: [f64; 3] = std::array::from_fn(|i| {
                viewmat[i][0] * m[0] + viewmat[i][1] * m[1] + viewmat[i][2] * m[2] + viewmat[i][3]
            });
            let q = scene.quats[id];
            let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let [w, x, y, z] = q.map(|v| v / length);
            let rotation = [
                [
                    1.0 - 2.0 * (y * y + z * z),
                    2.0 * (x * y - w * z),
                    2.0 * (x * z + w * y),
                ],
                [
                    2.0 * (x * y + w * z),
                    1.0 - 2.0 * (x * x + z * z),
                    2.0 * (y * z - w * x),
                ],
                [
                    2.0 * (x * z - w * y),
                    2.0 * (y * z + w * x),
                    1.0 - 2.0 * (x * x + y * y),
                ],
            ];
            let margin = [0.15 * width as f64, 0.15 * height as f64];
            let sx = (p[0] / p[2]).clamp(-(cx + margin[0]) / fx, (width as f64 - cx + margin[0]) / fx);
            let sy = (p[1] / p[2]).clamp(-(cy + margin[1]) / fy, (height as f64 - cy + margin[1]) / fy);
            let (centre, jacobian) = match model {
                CameraModel::Pinhole => (
                    [fx * p[0] / p[2] + cx, fy * p[1] / p[2] + cy],
                    [
                        [fx / p[2], 0.0, -fx * sx / p[2]],
                        [0.0, fy / p[2], -fy * sy / p[2]],
                    ],
                ),
                CameraModel::Orthographic => {
                    ([fx * p[0] + cx, fy * p[1] + cy], [[fx, 0.0, 0.0], [0.0, fy, 0.0]])
                }
                _ => panic!("{model:?} has no reference"),
            };
            let a: [[f64; 3]; 2] = std::array::from_fn(|row| {
                std::array::from_fn(|k| {
                    let mut sum = 0.0;
                    for i in 0..3 {
                        for j in 0..3 {
                            sum += jacobian[row][i] * viewmat[i][j] * rotation[j][k] * scene.scales[id][k];
                        }
                    }
                    sum
                })
            });
            let product = |r: usize, c: usize| (0..3).map(|k| a[r][k] * a[c][k]).sum::<f64>();
            let (xx, xy, yy) = (
                product(0, 0) + settings.eps2d,
                product(0, 1),
                product(1, 1) + settings.eps2d,
            );
            let det = xx * yy - xy * xy;
            Flat {
                centre,
                inverse: [yy / det, -xy / det, xx / det],
                depth: p[2],
                id,
            }
        })
        .filter(|flat| flat.depth > settings.near_plane && flat.depth < settings.far_plane)
        .collect();
    flats.sort_by(|a, b| a.depth.total_cmp(&b.depth));

    let mut colors = vec![0.0; width * height * scene.channels];
    let mut alphas = vec![0.0; width * height];
    for pixel in 0..width * height {
        let (x, y) = ((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        let mut transmittance = 1.0;
        for flat in &flats {
            let (dx, dy) = (x - flat.centre[0], y - flat.centre[1]);
            let q = flat.inverse[0] * dx * dx + 2.0 * flat.inverse[1] * dx * dy + flat.inverse[2] * dy * dy;
            let alpha = (scene.opacities[flat.id] * (-0.5 * q).exp()).min(settings.max_alpha);
            if alpha < settings.alpha_threshold {
                continue;
            }
            if transmittance * (1.0 - alpha) <= settings.min_transmittance {
                break;
            }
            for channel in 0..scene.channels {
                colors[pixel * scene.channels + channel] +=
                    alpha * transmittance * scene.colors[flat.id * scene.channels + channel];
            }
            transmittance *= 1.0 - alpha;
        }
        alphas[pixel] = 1.0 - transmittance;
    }
    (colors, alphas)
}

/// Relative L2 difference.
pub fn relative<T: Scalar>(got: &[T], expected: &[f64]) -> f64 {
    assert_eq!(got.len(), expected.len());
    let difference: f64 = got
        .iter()
        .zip(expected)
        .map(|(a, b)| (a.as_f64() - b).powi(2))
        .sum();
    (difference / expected.iter().map(|b| b * b).sum::<f64>()).sqrt()
}

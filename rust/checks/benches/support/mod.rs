//! Four scenes that ask different things of a renderer, made from a seed.

use std::f32::consts::TAU;

use bigs_raster::{Camera, Gaussians, Intrinsics};
use fastrand::Rng;

/// Half the tangent of what the cameras below see, and a little more so that Gaussians also cross the border.
const HALF_WIDTH: f32 = 1.15 * 0.5 / 1.2;

/// Gaussians and the camera that looks at them.
pub(crate) struct Workload {
    pub(crate) name: &'static str,
    pub(crate) camera: Camera<f32>,
    means: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    opacities: Vec<f32>,
    colors: Vec<f32>,
}

impl Workload {
    pub(crate) fn all() -> [Self; 4] {
        [
            Self::hand_and_object("A", 10_000, 256, false),
            Self::hand_and_object("B", 50_000, 512, true),
            Self::dense_scene("C", 200_000, 800),
            Self::faint_pile("D", 5_000, 128),
        ]
    }

    /// A box that two ellipsoids touch, half a metre away: round splats of 2 mm, or thin discs on the surface.
    fn hand_and_object(name: &'static str, count: usize, size: usize, discs: bool) -> Self {
        let mut rng = Rng::with_seed(1);
        let mut workload = Self::empty(name, size, [-0.02, 0.0, 0.48]);
        for _ in 0..count {
            let (mean, normal) = match rng.f32() {
                part if part < 0.6 => on_box(&mut rng, 0.06),
                part if part < 0.85 => on_ellipsoid(&mut rng, [0.085, 0.03, -0.045], [0.045, 0.03, 0.06]),
                _ => on_ellipsoid(&mut rng, [0.035, -0.02, -0.105], [0.014, 0.055, 0.014]),
            };
            let mut wide = |middle: f32, spread: f32| middle * (spread * normal_number(&mut rng)).exp();
            let (scale, quat) = if discs {
                (
                    [wide(0.0015, 0.3), wide(0.0009, 0.3), wide(0.000_25, 0.3)],
                    facing(normal, rng.f32() * TAU),
                )
            } else {
                ([wide(0.002, 0.1); 3], [1.0, 0.0, 0.0, 0.0])
            };
            // Seen from a corner of the box.
            let mean = turned(mean);
            let opacity = 0.5 + 0.5 * rng.f32();
            workload.push(mean, quat, scale, opacity, &mut rng);
        }
        workload
    }

    /// Random splats between 1 and 6 m away, most of a few pixels and some large.
    fn dense_scene(name: &'static str, count: usize, size: usize) -> Self {
        let mut rng = Rng::with_seed(2);
        let mut workload = Self::empty(name, size, [0.0; 3]);
        for _ in 0..count {
            let mean = in_view(&mut rng, 1.0, 6.0);
            let quat = [0; 4].map(|_| normal_number(&mut rng));
            let scale = [0; 3].map(|_| 0.0062 * (0.6 * normal_number(&mut rng)).exp());
            let opacity = 1.0 / (1.0 + (-1.5 * normal_number(&mut rng)).exp());
            workload.push(mean, quat, scale, opacity, &mut rng);
        }
        workload
    }

    /// Faint splats that each cover much of the image: nothing can be culled.
    fn faint_pile(name: &'static str, count: usize, size: usize) -> Self {
        let mut rng = Rng::with_seed(3);
        let mut workload = Self::empty(name, size, [0.0; 3]);
        for _ in 0..count {
            let mean = in_view(&mut rng, 1.0, 2.0);
            let mut part = || 0.25 * normal_number(&mut rng);
            let quat = [1.0 + part(), part(), part(), part()];
            let scale = [1.0, 1.0, 0.2].map(|flat| flat * (0.08 + 0.22 * rng.f32()));
            let opacity = 0.01 + 0.05 * rng.f32();
            workload.push(mean, quat, scale, opacity, &mut rng);
        }
        workload
    }

    /// Nothing yet, seen by a camera that is moved but not turned.
    fn empty(name: &'static str, size: usize, shift: [f32; 3]) -> Self {
        let row = |i: usize| {
            std::array::from_fn(|j| {
                if j == 3 {
                    shift[i]
                } else {
                    f32::from(u8::from(i == j))
                }
            })
        };
        let viewmat = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
        let (focal, middle) = (1.2 * size as f32, 0.5 * size as f32);
        let k = Intrinsics {
            fx: focal,
            fy: focal,
            cx: middle,
            cy: middle,
        };
        Self {
            name,
            camera: Camera::new(viewmat, k, size, size).expect("a camera"),
            means: Vec::new(),
            quats: Vec::new(),
            scales: Vec::new(),
            opacities: Vec::new(),
            colors: Vec::new(),
        }
    }

    fn push(&mut self, mean: [f32; 3], quat: [f32; 4], scale: [f32; 3], opacity: f32, rng: &mut Rng) {
        self.means.push(mean);
        self.quats.push(quat);
        self.scales.push(scale);
        self.opacities.push(opacity);
        self.colors.extend([rng.f32(), rng.f32(), rng.f32()]);
    }

    pub(crate) fn gaussians(&self) -> Gaussians<'_, f32> {
        self.first(self.means.len())
    }

    /// So many of them.
    pub(crate) fn first(&self, count: usize) -> Gaussians<'_, f32> {
        Gaussians::new(
            &self.means[..count],
            &self.quats[..count],
            &self.scales[..count],
            &self.opacities[..count],
            &self.colors[..3 * count],
            3,
        )
        .expect("splats")
    }
}

/// From the normal distribution.
fn normal_number(rng: &mut Rng) -> f32 {
    (-2.0 * (1.0 - rng.f32()).ln()).sqrt() * (TAU * rng.f32()).cos()
}

/// A point in the frustum.
fn in_view(rng: &mut Rng, near: f32, far: f32) -> [f32; 3] {
    let z = near + (far - near) * rng.f32();
    let mut across = || (2.0 * rng.f32() - 1.0) * HALF_WIDTH * z;
    [across(), across(), z]
}

/// A point on a cube around the origin, and the normal there.
fn on_box(rng: &mut Rng, half: f32) -> ([f32; 3], [f32; 3]) {
    let (axis, sign) = (rng.usize(0..3), if rng.bool() { 1.0 } else { -1.0 });
    let mut point = [0; 3].map(|_| (2.0 * rng.f32() - 1.0) * half);
    let mut normal = [0.0; 3];
    point[axis] = sign * half;
    normal[axis] = sign;
    (point, normal)
}

/// A point on an ellipsoid, and the normal there.
fn on_ellipsoid(rng: &mut Rng, centre: [f32; 3], semi: [f32; 3]) -> ([f32; 3], [f32; 3]) {
    let (azimuth, height) = (rng.f32() * TAU, 2.0 * rng.f32() - 1.0);
    let flat = (1.0 - height * height).sqrt();
    let direction = [flat * azimuth.cos(), flat * azimuth.sin(), height];
    let across = [0, 1, 2].map(|i| direction[i] / semi[i]);
    let length = (across[0] * across[0] + across[1] * across[1] + across[2] * across[2]).sqrt();
    (
        [0, 1, 2].map(|i| centre[i] + semi[i] * direction[i]),
        across.map(|v| v / length),
    )
}

/// Turned by 33° about y.
fn turned([x, y, z]: [f32; 3]) -> [f32; 3] {
    let (sin, cos) = 33f32.to_radians().sin_cos();
    [cos * x + sin * z, y, cos * z - sin * x]
}

/// A rotation of the z axis onto the turned normal, spun about it.
fn facing(normal: [f32; 3], spin: f32) -> [f32; 4] {
    let n = turned(normal);
    // z onto n, then the spin about z first: the product of two quaternions, the second without x and y.
    let (w, x, y) = if n[2] > -0.9999 {
        (1.0 + n[2], -n[1], n[0])
    } else {
        (0.0, 1.0, 0.0)
    };
    let (sin, cos) = (spin / 2.0).sin_cos();
    [w * cos, x * cos + y * sin, y * cos - x * sin, w * sin]
}

//! The built-in scene: a knotted tube of little discs above a chequered floor, with y down as in captured scenes.

use std::f32::consts::TAU;

use super::splats::Splats;

/// Radius of the tube; the knot itself is about 1 across.
const TUBE: f32 = 0.16;
/// Below the knot.
const FLOOR: f32 = 0.75;
const FLOOR_RADIUS: f32 = 1.5;

/// `detail` = 1 has about fifty thousand Gaussians, and their number goes with its square.
pub(crate) fn scene(detail: f32) -> Splats {
    let mut splats = Splats::default();
    let count = |full: f32| (full * detail).max(3.0) as usize;
    tube(&mut splats, count(700.0), count(56.0), detail);
    floor(&mut splats, count(110.0));
    splats
}

fn tube(splats: &mut Splats, along: usize, around: usize, detail: f32) {
    for i in 0..along {
        let u = i as f32 / along as f32 * TAU;
        let centre = knot(u);
        let tangent = unit(minus(knot(u + 1e-3), knot(u - 1e-3)));
        let side = unit(cross(tangent, [0.0, 1.0, 0.0]));
        let other = cross(side, tangent);
        for j in 0..around {
            let (sin, cos) = (j as f32 / around as f32 * TAU).sin_cos();
            let normal = [0, 1, 2].map(|k| cos * side[k] + sin * other[k]);
            let mean = [0, 1, 2].map(|k| centre[k] + TUBE * normal[k]);
            let stripe = if (i * 24 / along + j * 4 / around).is_multiple_of(2) {
                1.0
            } else {
                0.75
            };
            let hue = [0.0, 1.0, 2.0].map(|c| 0.55 + 0.4 * (u + c * TAU / 3.0).cos());
            let rgb = hue.map(|v| stripe * shade(normal) * v);
            let radius = 0.011 / detail;
            splats.push(mean, facing(normal), [radius, radius, 0.002], 0.95, rgb);
        }
    }
}

fn floor(splats: &mut Splats, side: usize) {
    let step = 2.0 * FLOOR_RADIUS / side as f32;
    for i in 0..side {
        for j in 0..side {
            let (x, z) = (i as f32 * step - FLOOR_RADIUS, j as f32 * step - FLOOR_RADIUS);
            if x * x + z * z > FLOOR_RADIUS * FLOOR_RADIUS {
                continue;
            }
            let dark = ((x / 0.3).floor() + (z / 0.3).floor()).rem_euclid(2.0) < 1.0;
            let rgb = [if dark { 0.35 } else { 0.8 }; 3];
            let radius = 0.65 * step;
            let up = [0.0, -1.0, 0.0];
            splats.push([x, FLOOR, z], facing(up), [radius, radius, 0.001], 0.95, rgb);
        }
    }
}

/// The trefoil, lying in the plane of the floor.
fn knot(u: f32) -> [f32; 3] {
    let ring = 2.0 + (3.0 * u).cos();
    [
        ring * (2.0 * u).cos() / 3.0,
        -(3.0 * u).sin() / 3.0,
        ring * (2.0 * u).sin() / 3.0,
    ]
}

/// Light from above and from one side.
fn shade(normal: [f32; 3]) -> f32 {
    0.55 + 0.45 * (0.5 * normal[0] - 0.8 * normal[1] + 0.33 * normal[2]).max(0.0)
}

/// The shortest rotation of the z axis onto a unit vector.
fn facing(normal: [f32; 3]) -> [f32; 4] {
    if normal[2] < -0.9999 {
        return [0.0, 1.0, 0.0, 0.0];
    }
    [1.0 + normal[2], -normal[1], normal[0], 0.0]
}

fn minus(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [0, 1, 2].map(|k| a[k] - b[k])
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    v.map(|x| x / length)
}

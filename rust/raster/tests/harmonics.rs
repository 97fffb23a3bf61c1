//! Gaussians with spherical harmonics: as if their colours had been worked out by hand, and gradients to everything that a
//! colour depends on. And buffers of the caller's.

mod support;

use bigs_raster::{Camera, Gaussians, Harmonics, RasterError, RasterSettings, RenderMode, Renderer};
use support::{Random, Scene, VIEWMAT, camera};

const SIZE: usize = 13;
const DEGREE: usize = 3;
const BASES: usize = 16;

struct Lit {
    scene: Scene<f64>,
    coefficients: Vec<f64>,
}

impl Lit {
    fn new(n: usize) -> Self {
        let mut r = Random::new(7);
        Self {
            scene: Scene::random(n, 0, 3),
            coefficients: (0..n * BASES * 3).map(|_| r.uniform(-0.6, 0.6)).collect(),
        }
    }

    fn view(&self) -> Gaussians<'_, f64> {
        let s = &self.scene;
        Gaussians::with_harmonics(
            &s.means,
            &s.quats,
            &s.scales,
            &s.opacities,
            DEGREE,
            BASES,
            &self.coefficients,
        )
        .unwrap()
    }

    fn loss(&self, viewmat: [[f64; 4]; 4], v: &[f64]) -> f64 {
        let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb).unwrap();
        let frame = renderer
            .render(&self.view(), &camera(viewmat, SIZE, SIZE), Some(&[0.2, 0.4, 0.1]))
            .unwrap();
        frame.colors.iter().zip(v).map(|(a, b)| a * b).sum()
    }
}

fn weights() -> Vec<f64> {
    let mut r = Random::new(9);
    (0..SIZE * SIZE * 3).map(|_| r.uniform(-1.0, 1.0)).collect()
}

#[test]
fn colours_are_those_of_the_directions_from_the_camera() {
    let lit = Lit::new(30);
    let camera: Camera<f64> = camera(VIEWMAT, SIZE, SIZE);
    let eye = camera.eye();
    let dirs: Vec<[f64; 3]> = lit
        .scene
        .means
        .iter()
        .map(|m| [m[0] - eye.x, m[1] - eye.y, m[2] - eye.z])
        .collect();
    let sums = Harmonics::new(DEGREE, BASES, &dirs, &lit.coefficients, None)
        .unwrap()
        .evaluate();
    let colors: Vec<f64> = sums
        .into_flattened()
        .into_iter()
        .map(|v| (v + 0.5).max(0.0))
        .collect();
    assert!(colors.contains(&0.0), "some colours are limited");
    let painted = Scene {
        colors,
        channels: 3,
        ..lit.scene.clone()
    };
    for mode in [RenderMode::Rgb, RenderMode::RgbExpectedDepth, RenderMode::Depth] {
        let renderer = Renderer::new(&RasterSettings::default(), mode).unwrap();
        let (a, b) = (
            renderer.render(&lit.view(), &camera, None).unwrap(),
            renderer.render(&painted.view(), &camera, None).unwrap(),
        );
        assert!(a.colors == b.colors && a.alphas == b.alphas);
    }
}

#[test]
fn gradients_are_finite_differences() {
    let mut lit = Lit::new(12);
    let v = weights();
    let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb)
        .unwrap()
        .with_absgrad();
    let frame = renderer
        .render(&lit.view(), &camera(VIEWMAT, SIZE, SIZE), Some(&[0.2, 0.4, 0.1]))
        .unwrap();
    let grads = frame.vjp(&lit.view(), &v, &[0.0; SIZE * SIZE]).unwrap();
    let h = 1e-6;
    let close = |what: &str, got: f64, plus: f64, minus: f64| {
        let expected = (plus - minus) / (2.0 * h);
        assert!(
            (got - expected).abs() < 2e-6 * (1.0 + expected.abs()),
            "{what}: {got} against {expected}"
        );
    };
    assert_eq!(grads.colors.len(), lit.coefficients.len());
    for i in (0..lit.coefficients.len()).step_by(7) {
        let at = lit.coefficients[i];
        lit.coefficients[i] = at + h;
        let plus = lit.loss(VIEWMAT, &v);
        lit.coefficients[i] = at - h;
        let minus = lit.loss(VIEWMAT, &v);
        lit.coefficients[i] = at;
        close("coefficient", grads.colors[i], plus, minus);
    }
    for (i, axis) in (0..12).flat_map(|i| [(i, 0), (i, 1), (i, 2)]) {
        let at = lit.scene.means[i][axis];
        lit.scene.means[i][axis] = at + h;
        let plus = lit.loss(VIEWMAT, &v);
        lit.scene.means[i][axis] = at - h;
        let minus = lit.loss(VIEWMAT, &v);
        lit.scene.means[i][axis] = at;
        close("mean", grads.means[i][axis], plus, minus);
    }
    for (row, column) in (0..3).flat_map(|row| [(row, 0), (row, 1), (row, 2), (row, 3)]) {
        let moved = |by: f64| {
            let mut viewmat = VIEWMAT;
            viewmat[row][column] += by;
            lit.loss(viewmat, &v)
        };
        close("viewmat", grads.viewmat[row][column], moved(h), moved(-h));
    }
}

#[test]
fn harmonics_and_colours_are_not_mixed_up() {
    let lit = Lit::new(5);
    let painted = Scene::<f64>::random(5, 3, 1);
    let camera = camera(VIEWMAT, SIZE, SIZE);
    let renderer = Renderer::new(&RasterSettings::default(), RenderMode::Rgb).unwrap();
    let (v, v_alphas) = (weights(), [0.0; SIZE * SIZE]);
    let of_lit = renderer.render(&lit.view(), &camera, None).unwrap();
    let of_painted = renderer.render(&painted.view(), &camera, None).unwrap();
    assert!(of_lit.vjp(&painted.view(), &v, &v_alphas).is_err());
    assert!(of_painted.vjp(&lit.view(), &v, &v_alphas).is_err());
    assert!(of_lit.vjp(&Lit::new(4).view(), &v, &v_alphas).is_err());
    let s = &lit.scene;
    for (degree, bases, len) in [
        (4, 25, 375),
        (1, 3, 45),
        (0, 1 << 60, 15),
        (3, 16, 5 * 48 - 1),
        (0, 0, 0),
    ] {
        let values = vec![0.0; len];
        let refused = Gaussians::with_harmonics(
            &s.means,
            &s.quats,
            &s.scales,
            &s.opacities,
            degree,
            bases,
            &values,
        );
        assert!(refused.is_err(), "degree {degree}, {bases} bases");
    }
    let bright = vec![f64::MAX; 5 * 48];
    let bright =
        Gaussians::with_harmonics(&s.means, &s.quats, &s.scales, &s.opacities, 3, 16, &bright).unwrap();
    let error = renderer.render(&bright, &camera, None).unwrap_err();
    assert!(matches!(
        error,
        RasterError::NotFinite {
            name: "harmonics",
            ..
        }
    ));
}

#[test]
fn buffers_of_the_caller_hold_the_same_image() {
    let scene = Scene::<f32>::random(40, 3, 2);
    let camera = camera(VIEWMAT, SIZE, SIZE);
    for (mode, background) in [
        (RenderMode::RgbDepth, None),
        (RenderMode::Rgb, Some(&[0.1, 0.2, 0.3][..])),
    ] {
        let renderer = Renderer::new(&RasterSettings::default(), mode).unwrap();
        let own = renderer.render(&scene.view(), &camera, background).unwrap();
        let (mut colors, mut alphas) = (vec![f32::NAN; own.colors.len()], vec![7.0; own.alphas.len()]);
        let frame = renderer
            .render_into(&scene.view(), &camera, background, &mut colors, &mut alphas)
            .unwrap();
        assert!(colors == own.colors && alphas == own.alphas);
        assert!(frame.colors.is_empty() && frame.radii == own.radii);
        let v: Vec<f32> = (0..colors.len()).map(|i| (i % 3) as f32).collect();
        let v_alphas = vec![0.5; alphas.len()];
        assert_eq!(
            frame.vjp(&scene.view(), &v, &v_alphas).unwrap(),
            own.vjp(&scene.view(), &v, &v_alphas).unwrap()
        );
        let short = renderer.render_into(&scene.view(), &camera, background, &mut colors[1..], &mut alphas);
        assert!(matches!(
            short,
            Err(RasterError::LengthMismatch { name: "colors", .. })
        ));
    }
}

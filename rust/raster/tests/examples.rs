//! The examples run on small inputs and show what they should, so that they cannot rot.

// Each example brings its own copy of what they share.
#![allow(clippy::duplicate_mod)]

#[path = "../examples/fit_image.rs"]
#[allow(dead_code)]
mod fit_image;
#[path = "../examples/render.rs"]
#[allow(dead_code)]
mod render;

use std::fs::File;
use std::io::BufReader;

/// A path for a file of one test.
fn temporary(name: &str) -> String {
    format!("{}/{name}", env!("CARGO_TARGET_TMPDIR"))
}

fn run_render(arguments: &[&str]) -> Result<(), String> {
    render::run(arguments.iter().map(ToString::to_string).collect::<Vec<_>>()).map_err(|e| e.to_string())
}

struct Shown {
    width: usize,
    height: usize,
    frames: u32,
    rgb: Vec<u8>,
}

impl Shown {
    fn of(path: &str) -> Self {
        let source = BufReader::new(File::open(path).unwrap());
        let mut reader = png::Decoder::new(source).read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut rgb).unwrap();
        let info = reader.info();
        Self {
            width: info.width as usize,
            height: info.height as usize,
            frames: info.animation_control.map_or(1, |control| control.num_frames),
            rgb,
        }
    }

    fn pixel(&self, column: usize, row: usize) -> [u8; 3] {
        let first = (row * self.width + column) * 3;
        [0, 1, 2].map(|i| self.rgb[first + i])
    }
}

/// A text file with one row of numbers per Gaussian, with these properties.
fn write_ascii(name: &str, properties: &[&str], rows: &[&str]) -> String {
    let path = temporary(name);
    let mut file = format!(
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex {}\n",
        rows.len()
    );
    for property in properties {
        file += &format!("property {property}\n");
    }
    file += "end_header\n";
    file += &rows.join("\n");
    file += "\n";
    std::fs::write(&path, file).unwrap();
    path
}

const PROPERTIES: [&str; 16] = [
    "float x",
    "double y",
    "float z",
    "uchar label",
    "float f_dc_0",
    "float f_dc_1",
    "float f_dc_2",
    "list uchar int neighbours",
    "float opacity",
    "float scale_0",
    "float scale_1",
    "float scale_2",
    "float rot_0",
    "float rot_1",
    "float rot_2",
    "float rot_3",
];
/// Red, at y = −1: above the others where −y is up. Then green and blue.
const ROWS: [&str; 3] = [
    "0 -1 0 7 1.77 -1.77 -1.77 0 9 -1.5 -1.5 -1.5 1 0 0 0",
    "0 0 0 7 -1.77 1.77 -1.77 2 1 2 9 -1.5 -1.5 -1.5 1 0 0 0",
    "0 1 0 7 -1.77 -1.77 1.77 1 0 9 -1.5 -1.5 -1.5 1 0 0 0",
];

#[test]
fn the_built_in_scene_survives_a_file() {
    let (ply, direct, again) = (
        temporary("knot.ply"),
        temporary("knot.png"),
        temporary("again.png"),
    );
    let common = ["--size", "64x48", "--detail", "0.12"];
    let arguments = [&common[..], &["--out", &direct, "--save-ply", &ply]].concat();
    run_render(&arguments).unwrap();
    let arguments = [&common[..], &["--out", &again, &ply]].concat();
    run_render(&arguments).unwrap();
    let (direct, again) = (Shown::of(&direct), Shown::of(&again));
    assert_eq!((direct.width, direct.height), (64, 48));
    let seen = direct.rgb.iter().filter(|&&v| v < 200).count();
    assert!(
        seen > direct.rgb.len() / 8,
        "{seen} values are darker than the background"
    );
    assert!(
        direct
            .rgb
            .iter()
            .zip(&again.rgb)
            .all(|(a, b)| a.abs_diff(*b) <= 1)
    );
}

#[test]
fn text_files_with_extra_properties_are_read_and_the_right_way_up() {
    let ply = write_ascii("three.ply", &PROPERTIES, &ROWS);
    let out = temporary("three.png");
    for (up, upper, model) in [
        ("-y", [255, 0, 0], "--antialiased"),
        ("y", [0, 0, 255], "--orthographic"),
    ] {
        let arguments = [
            &ply,
            model,
            "--up",
            up,
            "--out",
            &out,
            "--size",
            "60x60",
            "--elevation",
            "0",
            "--background",
            "0",
        ];
        run_render(&arguments).unwrap();
        let shown = Shown::of(&out);
        let top = (0..60)
            .map(|row| shown.pixel(30, row))
            .find(|&p| p.iter().any(|&v| v > 100));
        let strongest = |p: [u8; 3]| (0..3).max_by_key(|&i| p[i]);
        assert_eq!(strongest(top.expect("something is shown")), strongest(upper));
        let [r, g, b] = shown.pixel(30, 30);
        assert!(g > 240 && r < 15 && b < 15, "the middle is green: {r} {g} {b}");
    }
}

#[test]
fn harmonics_change_with_the_side_they_are_seen_from() {
    // Grey, but green grows along −y and red along z: seen from below (y) green is bright, from behind (−z) red.
    let mut properties = PROPERTIES.map(String::from).to_vec();
    properties.extend((0..9).map(|i| format!("float f_rest_{i}")));
    let properties: Vec<&str> = properties.iter().map(String::as_str).collect();
    let row = "0 0 0 7 0 0 0 0 9 -1 -1 -1 1 0 0 0  0 1 0  1 0 0  0 0 0";
    let ply = write_ascii("harmonics.ply", &properties, &[row]);
    let middle = |axes: [&str; 4]| {
        let out = temporary("harmonics.png");
        let common = [&ply, "--size", "21x21", "--out", &out, "--up"];
        run_render(&[&common[..], &axes[..1], &["--azimuth", axes[1], axes[2], axes[3]]].concat()).unwrap();
        Shown::of(&out).pixel(10, 10)
    };
    let below = middle(["y", "0", "--elevation", "90"]);
    let above = middle(["y", "0", "--elevation", "-90"]);
    assert!(
        below[1] > 200 && above[1] < 50 && below[0].abs_diff(above[0]) < 3,
        "{below:?} {above:?}"
    );
    let behind = middle(["z", "0", "--elevation", "-90"]);
    let before = middle(["z", "0", "--elevation", "90"]);
    assert!(
        behind[0] > 200 && before[0] < 50 && behind[2].abs_diff(before[2]) < 3,
        "{behind:?} {before:?}"
    );
}

#[test]
fn turntables_are_animations_or_folders() {
    let ply = write_ascii("turn.ply", &PROPERTIES, &ROWS);
    let (animation, folder) = (temporary("turn.png"), temporary("turn"));
    let common = [&ply, "--size", "32x20", "--frames", "3", "--up", "x"];
    run_render(&[&common[..], &["--out", &animation]].concat()).unwrap();
    assert_eq!(Shown::of(&animation).frames, 3);
    run_render(&[&common[..], &["--out", &folder]].concat()).unwrap();
    let frames = ["0000", "0001", "0002"].map(|name| Shown::of(&format!("{folder}/{name}.png")));
    assert!(frames[0].rgb != frames[1].rgb && frames[1].rgb != frames[2].rgb);
}

#[test]
fn unusable_files_are_named_with_their_fault() {
    let fault = |path: &str| run_render(&[path, "--out", &temporary("never.png")]).unwrap_err();
    let without: Vec<&str> = PROPERTIES
        .into_iter()
        .filter(|name| !name.ends_with("opacity") && !name.ends_with("rot_3"))
        .collect();
    let message = fault(&write_ascii("missing.ply", &without, &[]));
    assert!(
        message.contains("missing.ply") && message.ends_with("missing opacity, rot_3"),
        "{message}"
    );

    let mut rest = PROPERTIES.to_vec();
    rest.extend(["float f_rest_0", "float f_rest_1"]);
    let message = fault(&write_ascii("rest.ply", &rest, &[]));
    assert!(
        message.contains("0, 9, 24 or 45") && message.ends_with("found 2"),
        "{message}"
    );

    let message = fault(&write_ascii(
        "infinite.ply",
        &PROPERTIES,
        &[ROWS[0], &ROWS[1].replace(" 9 ", " 1e39 ")],
    ));
    assert!(message.ends_with("vertex 1 has opacity = inf"), "{message}");

    let path = temporary("short.ply");
    std::fs::write(
        &path,
        "ply\nformat binary_little_endian 1.0\nelement vertex 900000000000\nproperty float x\nend_header\n1234",
    )
    .unwrap();
    let message = fault(&path);
    assert!(message.contains("missing y, z"), "{message}");
    let whole = temporary("whole.ply");
    run_render(&[
        "--detail",
        "0.05",
        "--size",
        "8x8",
        "--out",
        &temporary("whole.png"),
        "--save-ply",
        &whole,
    ])
    .unwrap();
    let bytes = std::fs::read(&whole).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() - 3]).unwrap();
    let message = fault(&path);
    assert!(
        message.contains("short.ply") && message.contains("end of file"),
        "{message}"
    );

    std::fs::write(&path, "not a ply").unwrap();
    assert!(fault(&path).contains("expected a PLY file"));
    assert!(fault(&temporary("absent.ply")).contains("absent.ply"));
}

#[test]
fn options_are_checked() {
    for (arguments, part) in [
        (&["--size", "640"][..], "640x480"),
        (&["--fov", "180"], "--fov"),
        (&["--up", "w"], "expected x, y, z"),
        (&["--background", "1,2"], "one or three"),
        (&["--frames", "0"], "--frames"),
        (&["--no-such-option"], "--no-such-option"),
    ] {
        let message = run_render(arguments).unwrap_err();
        assert!(message.contains(part), "{message}");
    }
    run_render(&["--help"]).unwrap();
}

#[test]
fn fitting_improves_and_repeats_itself() {
    let fit = |name: &str, steps: &str, seed: &str| {
        let out = temporary(name);
        let arguments = [
            "--side",
            "36",
            "--gaussians",
            "60",
            "--steps",
            steps,
            "--seed",
            seed,
        ];
        let arguments = arguments.into_iter().chain(["--out", &out]);
        fit_image::run(arguments.map(ToString::to_string).collect::<Vec<_>>()).unwrap();
        Shown::of(&out).rgb
    };
    let target = fit_image::hills(36, 24).bytes();
    let error = |rgb: &[u8]| {
        let squares = rgb
            .iter()
            .zip(&target)
            .map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
        squares.sum::<f64>() / rgb.len() as f64
    };
    let (before, after) = (fit("before.png", "0", "0"), fit("after.png", "40", "0"));
    assert!(
        error(&after) < 0.1 * error(&before),
        "{} {}",
        error(&before),
        error(&after)
    );
    assert_eq!(after, fit("repeated.png", "40", "0"));
    assert_ne!(after, fit("other.png", "40", "1"));
}

#[test]
fn pictures_are_fitted_too() {
    let (picture, out) = (temporary("photo.png"), temporary("photo_fit.png"));
    let file = File::create(&picture).unwrap();
    let mut encoder = png::Encoder::new(file, 50, 30);
    encoder.set_color(png::ColorType::GrayscaleAlpha);
    let pixels: Vec<u8> = (0..50 * 30).flat_map(|i| [(i % 50) as u8 * 5, 255]).collect();
    encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
    let arguments = ["--side", "25", "--steps", "3", "--gaussians", "20"];
    let arguments = arguments.into_iter().chain(["--out", &out, &picture]);
    fit_image::run(arguments.map(ToString::to_string).collect::<Vec<_>>()).unwrap();
    let shown = Shown::of(&out);
    assert_eq!((shown.width, shown.height), (25, 15));
}

#[test]
fn a_fit_goes_on_from_its_file() {
    let (ply, first, again) = (
        temporary("fitted.ply"),
        temporary("fitted.png"),
        temporary("fitted_again.png"),
    );
    let fit = |arguments: &[&str]| {
        let common = ["--side", "24", "--gaussians", "40"];
        let arguments = [&common[..], arguments].concat();
        fit_image::run(arguments.iter().map(ToString::to_string).collect::<Vec<_>>()).unwrap();
    };
    fit(&["--steps", "20", "--out", &first, "--save-ply", &ply]);
    fit(&["--steps", "0", "--out", &again, "--start", &ply]);
    let (first, again) = (Shown::of(&first), Shown::of(&again));
    let same = first.rgb.iter().zip(&again.rgb).all(|(a, b)| a.abs_diff(*b) <= 1);
    assert!(same, "the file holds what was fitted");
    run_render(&[&ply, "--size", "20x20", "--out", &temporary("fitted_seen.png")]).unwrap();
}

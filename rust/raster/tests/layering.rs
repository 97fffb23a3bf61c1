//! The folders of `src` are layers: each uses only those before it, so that reading them in order needs no looking ahead.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// From the ground up. `error` is a file; all others are folders.
const LAYERS: [&str; 12] = [
    "error",
    "memory",
    "math",
    "simd",
    "input",
    "color",
    "project",
    "lists",
    "composite",
    "backproject",
    "pipeline",
    "api",
];

fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(sources(&path));
        } else {
            files.push(path);
        }
    }
    files
}

/// The files of this crate that a file names with `crate::`, in code or in `use`, as paths without `.rs`.
fn named(text: &str) -> BTreeSet<Vec<String>> {
    let code = text.lines().filter(|line| !line.trim_start().starts_with("//"));
    let mut found = BTreeSet::new();
    for line in code {
        for (at, _) in line.match_indices("crate::") {
            let path: String = line[at + "crate::".len()..]
                .chars()
                .take_while(|c| c.is_alphanumeric() || matches!(c, '_' | ':'))
                .collect();
            found.insert(path.split("::").map(str::to_string).collect());
        }
    }
    found
}

fn layer(name: &str) -> usize {
    LAYERS
        .iter()
        .position(|&layer| layer == name)
        .unwrap_or_else(|| panic!("{name}: expected one of the layers of this test"))
}

#[test]
fn layers_only_point_down() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut used = BTreeSet::new();
    for path in sources(&root) {
        let place = path.strip_prefix(&root).unwrap().with_extension("");
        let own = place.components().next().unwrap().as_os_str().to_str().unwrap();
        if own == "lib" {
            continue;
        }
        for target in named(&fs::read_to_string(&path).unwrap()) {
            assert!(
                layer(&target[0]) <= layer(own),
                "{}: expected nothing of a layer above, found crate::{}",
                place.display(),
                target.join("::")
            );
            used.insert(target[0].clone());
        }
        layer(own);
    }
    assert!(
        used.len() >= LAYERS.len() - 1,
        "found too few layers in use: {used:?}"
    );
}

#[test]
fn files_form_no_circle() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut edges = Vec::new();
    for path in sources(&root) {
        let place = path.strip_prefix(&root).unwrap().with_extension("");
        let own: Vec<String> = place
            .components()
            .map(|part| part.as_os_str().to_str().unwrap().to_string())
            .collect();
        // A folder's own file and its tests name what is inside them by nature.
        if matches!(own.last().unwrap().as_str(), "lib" | "mod" | "tests") {
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        for target in named(&text) {
            let file = (1..=target.len())
                .rev()
                .map(|parts| target[..parts].to_vec())
                .find(|parts| root.join(parts.join("/")).with_extension("rs").is_file());
            edges.extend(file.filter(|file| *file != own).map(|file| (own.clone(), file)));
        }
    }
    // Files that use nothing of what is left are taken away until none is.
    let mut left: BTreeSet<Vec<String>> = edges.iter().flat_map(|(a, b)| [a.clone(), b.clone()]).collect();
    assert!(left.len() > 25, "found too few files: {left:?}");
    loop {
        let before = left.len();
        let using: BTreeSet<Vec<String>> = edges
            .iter()
            .filter(|(from, to)| left.contains(from) && left.contains(to))
            .map(|(from, _)| from.clone())
            .collect();
        left.retain(|file| using.contains(file));
        if left.len() == before {
            break;
        }
    }
    assert!(
        left.is_empty(),
        "these files import each other in a circle: {left:?}"
    );
}

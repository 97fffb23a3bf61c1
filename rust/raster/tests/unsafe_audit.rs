//! `unsafe` stays where it has been looked at: in these files, and under a SAFETY comment each time.

use std::fs;
use std::path::{Path, PathBuf};

/// Files of `src` that may use `unsafe`.
const AUDITED: [&str; 4] = [
    "composite/backward.rs",
    "memory/shared_slice.rs",
    "simd/neon.rs",
    "simd/x86/mod.rs",
];

fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(sources(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
    files
}

/// The code of a line, without its comment.
fn code(line: &str) -> &str {
    line.split("//").next().unwrap_or_default()
}

fn is_unsafe(line: &str) -> bool {
    code(line)
        .split(|c: char| !(c.is_alphanumeric() || c == '_'))
        .any(|word| word == "unsafe")
}

/// Whether the comment right above a line, past attributes and the lines of one statement, says why it is sound.
fn is_explained(lines: &[&str], index: usize) -> bool {
    lines[..index]
        .iter()
        .rev()
        .take(8)
        .take_while(|line| !is_unsafe(line) || line.contains("SAFETY"))
        .any(|line| line.contains("// SAFETY: ") || line.contains("# Safety"))
}

#[test]
fn unsafe_code_is_where_it_was_audited_and_says_why() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let files = sources(&root);
    assert!(files.len() > 10, "the sources were found");
    let mut seen = Vec::new();
    for path in files {
        let name = path
            .strip_prefix(&root)
            .unwrap()
            .to_string_lossy()
            .replace('\\', "/");
        let text = fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        for (index, line) in lines.iter().enumerate() {
            if !is_unsafe(line) {
                continue;
            }
            let place = format!("{name}:{}", index + 1);
            assert!(
                AUDITED.contains(&name.as_str()),
                "{place}: unsafe outside {AUDITED:?}"
            );
            assert!(
                is_explained(&lines, index),
                "{place}: expected a SAFETY comment above"
            );
            seen.push(name.clone());
        }
        if lines.iter().any(|line| code(line).contains("allow(unsafe_code)")) {
            assert!(AUDITED.contains(&name.as_str()), "{name}: allows unsafe code");
        }
    }
    for name in AUDITED {
        assert!(
            seen.iter().any(|file| file == name),
            "{name}: no unsafe left, take it off the list"
        );
    }
}

"""Manifests: the same clips in every format, names, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bigs.checks import InputError
from bigs.commands.batch.manifest import Entry, read_manifest


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def test_a_line_a_clip(tmp_path: Path) -> None:
    path = written(tmp_path, "m.txt", "# two clips\na/build\n\nb   # the second\n/somewhere/else\n")
    entries = read_manifest(path)
    assert [entry.name for entry in entries] == ["a", "b", "else"]
    assert [entry.clip for entry in entries] == [
        tmp_path / "a" / "build",
        tmp_path / "b",
        Path("/somewhere/else"),
    ]


def test_the_same_in_csv_yaml_and_json(tmp_path: Path) -> None:
    rows = [
        {"clip": "a", "name": "first", "preset": "fast", "set": ["seed=3", "lighting=false"]},
        {"clip": "b", "hand_model": "hands", "gt": "b/gt.npz", "without": ["contact"]},
    ]
    csv = (
        "clip,name,preset,hand_model,gt,set,without\n"
        "a,first,fast,,,seed=3;lighting=false,\n"
        "b,,,hands,b/gt.npz,,contact\n"
    )
    wanted = [
        Entry(tmp_path / "a", "first", "fast", set=("seed=3", "lighting=false")),
        Entry(
            tmp_path / "b",
            "b",
            hand_model=tmp_path / "hands",
            gt=tmp_path / "b" / "gt.npz",
            without=("contact",),
        ),
    ]
    assert read_manifest(written(tmp_path, "m.csv", csv)) == wanted
    assert read_manifest(written(tmp_path, "m.json", json.dumps(rows))) == wanted
    # JSON is YAML, too.
    assert read_manifest(written(tmp_path, "m.yaml", json.dumps({"clips": rows}))) == wanted


def test_defaults_give_way_to_entries(tmp_path: Path) -> None:
    text = "defaults: {preset: fast, gt: t.npz}\nclips:\n- a\n- {clip: b, preset: smoke}\n"
    first, second = read_manifest(written(tmp_path, "m.yaml", text))
    assert (first.preset, second.preset) == ("fast", "smoke")
    assert first.gt == second.gt == tmp_path / "t.npz"


def test_settings_of_defaults_and_entries_add_up(tmp_path: Path) -> None:
    text = "defaults: {set: [seed=1, lighting=false]}\nclips:\n- a\n- {clip: b, set: seed=2}\n"
    first, second = read_manifest(written(tmp_path, "m.yaml", text))
    assert first.set == ("seed=1", "lighting=false")
    assert second.set == ("seed=1", "lighting=false", "seed=2")  # the last one counts


def test_names_do_not_repeat(tmp_path: Path) -> None:
    text = "- x/clip\n- y/clip\n- {clip: z/clip, name: clip}\n- {clip: strange name!}\n"
    names = [entry.name for entry in read_manifest(written(tmp_path, "m.yaml", text))]
    assert names == ["clip_2", "clip_3", "clip", "strange_name_"]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("m.xml", "a", "expected one of .yaml, .yml, .json, .csv, .txt, found '.xml'"),
        ("m.txt", "# nothing\n", "expected at least one clip, found none"),
        ("m.yaml", "clips: [a\n", "expected YAML, found "),
        ("m.json", "{", "expected JSON, found "),
        ("m.yaml", "clip: a\n", "expected clips and defaults, found 'clip'"),
        ("m.yaml", "clips: a\n", "expected a list of clips, found str"),
        ("m.yaml", "clips: [a]\ndefaults: [fast]\n", "defaults: expected fields and values"),
        ("m.yaml", "- {clip: a, prest: fast}\n", "entry 1: field: expected one of clip, name, preset"),
        ("m.yaml", "- {preset: fast}\n", "entry 1: expected a field clip, found preset"),
        ("m.yaml", "- a\n- 7\n", "entry 2: clip: expected text, found 7"),
        ("m.yaml", "- {clip: a, set: 3}\n", "entry 1: set: expected a list of texts, found 3"),
        ("m.yaml", "- {clip: a, name: ../up}\n", "name: expected letters, digits"),
        ("m.yaml", "- {clip: a, name: x}\n- {clip: b, name: x}\n", "each name once, found 'x' again"),
        ("m.csv", "clip,preset\na,fast,more\n", "entry 1: field: expected one of"),
    ],
)
def test_what_cannot_be_is_named(tmp_path: Path, name: str, text: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        read_manifest(written(tmp_path, name, text))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_manifest_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"m\.txt: expected a manifest, found no such file"):
        read_manifest(tmp_path / "m.txt")


def test_an_entrys_plan_is_its_own(tmp_path: Path) -> None:
    """A configuration of an entry takes the place of the preset that the others have, and the other way."""
    text = "defaults: {preset: fast}\nclips:\n- {clip: a, config: plan.yaml}\n- b\n"
    first, second = read_manifest(written(tmp_path, "m.yaml", text))
    assert (first.preset, first.config) == (None, tmp_path / "plan.yaml")
    assert (second.preset, second.config) == ("fast", None)
    text = "defaults: {config: plan.yaml}\nclips:\n- {clip: a, preset: smoke}\n"
    (only,) = read_manifest(written(tmp_path, "n.yaml", text))
    assert (only.preset, only.config) == ("smoke", None)

"""What is damaged, and the command that reads it: one target for each kind of file."""

from __future__ import annotations

import random
import shlex
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from .codecs import (
    Change,
    change_csv,
    change_json,
    change_npy,
    change_npz,
    change_numbers,
    change_pickle,
    change_picture,
    change_safetensors,
    change_torch,
    change_words,
    change_yaml,
    change_zip,
)
from .corpus import SHORT
from .damage import damage_bytes, displace
from .hostile import number, text

CHANGES: dict[str, Change] = {
    ".json": change_json,
    ".yaml": change_yaml,
    ".csv": change_csv,
    ".txt": change_words,
    ".ply": change_words,
    ".obj": change_words,
    ".npz": change_npz,
    ".npy": change_npy,
    ".pkl": change_pickle,
    ".safetensors": change_safetensors,
    ".pt": change_torch,
    ".zip": change_zip,
    ".png": change_picture,
    ".jpg": change_picture,
    ".bin": change_numbers,
}
RUN_FORMATS = (
    *("ply", "spz", "splat-glb", "glb", "obj", "mesh", "hand-meshes"),
    *("poses", "mano", "arctic", "challenge"),
)

Words = Callable[[random.Random], str]


@dataclass(frozen=True)
class Target:
    """Where a case's files come from, which of them are damaged, and what reads them.

    A command is one line in which {corpus} stands for the valid files, {case} for this case's copy of
    `copied`, and {out} for the only folder that may be written.
    """

    copied: str  # folder of the corpus
    damaged: Sequence[str]  # patterns below it; the first is damaged as often as all others together
    commands: Sequence[str | Words]
    costly: Sequence[str] = ()  # commands that take seconds: every twentieth case
    codes: Sequence[int] = (0, 1, 2, 3)
    bare: bool = False  # no file is damaged: the words of the command are


def _settings(rng: random.Random) -> str:
    """--set with paths and values of all kinds."""
    paths = "seed raster.eps2d raster.tile_size object.n_gaussians hand.color stages.joint.steps hand.shared "
    paths += "stages.joint.weights.image stages.joint.lrs.object.triplane initial.smooth_hands lighting.new "
    paths += "stages.hands-fine.image_size hand.decoders.geometry_width stages.joint stages prior.kind x . "
    values = [
        str(number(rng)),
        text(rng),
        "[1, 2]",
        "{a: 1}",
        "9" * 5000,
        str(10**400),
        ".nan",
        "-.inf",
        "1e400",
    ]
    values += ["&a [*a]", "!!set {1}", "[" * 900, "{" * 30_000, "2000-01-01", "null", "yes", "0x10", ""]
    words = []
    for _ in range(rng.choice((1, 1, 2))):
        path = rng.choice(paths.split()) if rng.random() < 0.9 else text(rng)
        words += ["--set", rng.choice((f"{path}={rng.choice(values)}", path, f"{path}=", f"={path}"))]
    return " ".join(shlex.quote(word.replace("\0", "").replace("\ud800", "")) for word in words)


def _words(rng: random.Random) -> str:
    """Options with values that they have not."""
    value = shlex.quote(
        rng.choice((str(number(rng)), text(rng), "9" * rng.choice((400, 5000))))
        .replace("\0", "")
        .replace("\ud800", "x")
    )
    return rng.choice(
        (
            f"export {{corpus}}/run --format obj --out {{out}} --frames {value}",
            f"export {{corpus}}/run --format {value} --out {{out}}",
            f"info {value}",
            f"convert {{corpus}}/clip --out {{out}} --every {value}",
            f"convert {{corpus}}/clip --out {{out}} --width {value}",
            f"render {{corpus}}/run --cameras {value} --out {{out}}",
            f"demo --out {{out}} --seed {value} --preset {value}",
            f"eval {value} {value}",
            f"reconstruct {{corpus}}/nothing --out {{out}} --without {value}",
            f"reconstruct {{corpus}}/nothing --out {{out}} --threads {value}",
            f"reconstruct {{corpus}}/nothing --out {{out}} --prior-weights {value}",
            f"preprocess frames {{corpus}}/clip/build/image --out {{out}} --focal {value}",
            f"preprocess {{corpus}}/clip/build/image --out {{out}} --masks {value}",
            f"preprocess frames {{corpus}}/clip/build/image --out {{out}} --stride {value}",
            f"preprocess frames {{corpus}}/clip/build/image --out {{out}} --max-size {value}",
            f"preprocess frames {{corpus}}/clip/build/image --out {{out}} --K {value} 1 2 3",
            f"submission {{corpus}}/submission/preds.zip --sequences {value}",
            f"batch {{corpus}}/manifest/clips.csv --out {{out}} --workers {value} --without nothing",
            f"{value} {value}",
        )
    )


def _exported(rng: random.Random) -> str:
    return f"export {{case}} --format {rng.choice(RUN_FORMATS)} --out {{out}}"


_CLIP = ("info {case}", "convert {case} --out {out}/clip")
_RECONSTRUCT = "reconstruct {case} --out {out}/run " + " ".join(SHORT)
_DATA_SET = ("info {case}", "convert {case} --out {out}/clip --from-truth")
_EVALUATE = "eval {corpus}/run --gt {case}"
_MODEL = "info {corpus}/clip --hand-model {case}"
_CONFIG = "reconstruct {corpus}/nothing --out {out}/run --config {case}/config.yaml"

TARGETS: dict[str, Target] = {
    "clip": Target(
        "clip",
        ("build/data.npy", "build/image/*.png", "build/mask/*.png", "build/corres.txt"),
        _CLIP,
        costly=(_RECONSTRUCT,),
    ),
    "scene": Target(
        "run",
        ("scene.safetensors",),
        (_exported, _exported, "render {case} --cameras {corpus}/transforms/transforms.json --out {out}"),
        costly=("eval {case} --clip {corpus}/clip --gt {corpus}/clip/gt.npz",),
    ),
    "run": Target(
        "run",
        ("config.yaml", "metrics.json"),
        (
            "export {case} --format poses --out {out}",
            "eval {case} --clip {corpus}/clip --gt {corpus}/hands.npz",
        ),
    ),
    "config": Target("config", ("config.yaml",), (_CONFIG,), costly=(_CONFIG.replace("nothing", "clip"),)),
    "set": Target("config", (), (lambda rng: f"{_CONFIG} {_settings(rng)}",), bare=True),
    "words": Target("config", (), (_words,), bare=True, codes=(0, 1, 2, 3, 4)),
    "manifest": Target(
        "manifest",
        ("*",),
        tuple(
            f"batch {{case}}/clips.{suffix} --out {{out}} --retries 0 --without {last}"
            for suffix in ("json", "yaml", "csv", "txt")
            for last in ("smooth --workers -1", "nothing")
        ),
    ),
    "transforms": Target(
        "transforms",
        ("transforms.json",),
        ("render {corpus}/run --cameras {case}/transforms.json --out {out}",),
    ),
    "truth": Target(
        "clip",
        ("gt.npz", "gt_object.ply"),
        (_EVALUATE.replace("/run", "/run_of_hands"),),
        costly=(_EVALUATE,),
    ),
    "hand_model": Target(
        "hands", ("npz/MANO_RIGHT.npz", "pkl/MANO_RIGHT.pkl"), (f"{_MODEL}/npz", f"{_MODEL}/pkl")
    ),
    "keypoints": Target(
        "keypoints",
        ("keypoints.json", "hands.npz"),
        tuple(
            f"preprocess hands {{out}}/pictures {option}"
            for option in ("--keypoints {case}/keypoints.json", "--hands {case}/hands.npz")
        ),
    ),
    "clicks": Target(
        "clicks",
        ("clicks.json",),
        ("preprocess masks {out}/pictures --sam2 {corpus}/clicks --clicks {case}/clicks.json",),
    ),
    "frames": Target(
        "pictures",
        ("processed/frames.json", "processed/frames/*"),
        ("preprocess hands {case} --keypoints {corpus}/keypoints/keypoints.json",),
    ),
    "colmap_text": Target(
        "colmap_text",
        ("sparse/0/*.txt", "hands.npz", "images/*.png"),
        (*_CLIP, "preprocess frames {corpus}/clip/build/image --out {out} --colmap {case}/sparse/0"),
        costly=(_RECONSTRUCT,),
    ),
    "colmap_binary": Target("colmap_binary", ("sparse/0/*.bin", "hands.npz"), _CLIP),
    "nerfstudio": Target(
        "nerfstudio", ("transforms.json", "sparse_pc.ply", "hands.npz"), _CLIP, costly=(_RECONSTRUCT,)
    ),
    "submission": Target(
        "submission", ("preds.zip",), ("submission {case}/preds.zip --sequences {sequence}",)
    ),
    "arctic": Target(
        "arctic",
        ("raw_seqs/s01/*", "meta/misc.json", "meta/object_vtemplates/box/*", "images/s01/*/1/*"),
        _DATA_SET,
        costly=(_EVALUATE,),
    ),
    "ho3d": Target(
        "ho3d",
        ("train/SM1/meta/*", "models/*/textured_simple.obj", "train/SM1/rgb/*", "train.txt"),
        ("info {case}/train/SM1", "convert {case}/train/SM1 --out {out}/clip --from-truth"),
        costly=(f"{_EVALUATE}/train/SM1",),
    ),
}


def damage(rng: random.Random, target: Target, corpus: Path, case: Path) -> Path | None:
    """Damage one file of a case; returns which."""
    if target.bare:
        return None
    pattern = target.damaged[0] if rng.random() < 0.5 else rng.choice(target.damaged)
    path = rng.choice(sorted(file for file in case.glob(pattern) if file.is_file()))
    # The copy may share its bytes with the corpus.
    content = path.read_bytes()
    path.unlink()
    kind = rng.random()
    if kind < 0.3:
        path.write_bytes(damage_bytes(rng, content))
        return path
    path.write_bytes(content)
    if kind < 0.93:
        CHANGES[path.suffix](rng, path)
    elif kind < 0.97:
        displace(rng, path)
    else:
        others = [file for file in corpus.rglob("*") if file.is_file() and file.stat().st_size < 1 << 20]
        shutil.copyfile(rng.choice(sorted(others)), path)
    return path


def command_of(
    rng: random.Random, target: Target, costly: bool, corpus: Path, case: Path, out: Path
) -> list[str]:
    """The words of a case's command."""
    lines = target.costly if target.costly and costly else target.commands
    line = rng.choice(lines)
    words = shlex.split(line if isinstance(line, str) else line(rng))
    values = {
        "{corpus}": corpus,
        "{case}": case,
        "{out}": out,
        "{sequence}": (corpus / "submission" / "sequence").read_text(),
    }
    for name, value in values.items():
        words = [word.replace(name, str(value)) for word in words]
    return words

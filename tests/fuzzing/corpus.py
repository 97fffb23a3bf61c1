"""One valid file of every kind, made by the program's own writers."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
import yaml

from bigs.cli import main
from bigs.colmap import pycolmap
from bigs.data.formats.hold import load_hold
from bigs.data.formats.writers import CV_FROM_GL, write_arctic, write_colmap, write_ho3d, write_nerfstudio
from bigs.data.ground_truth import load_annotation
from bigs.data.moving import in_world, move_hand, move_object
from bigs.data.synthetic import make_clip
from bigs.hand import HandModel, load_hand_models
from bigs.models.playback_file import load_playback, save_playback
from bigs.types import SIDES

# A reconstruction of next to nothing: what it reads and writes is that of a whole one.
STAGES = ("hands-coarse", "hands-fine", "grasped", "appearance", "contact", "regrasp", "joint", "detail")
SHORT = [
    *("--preset", "smoke", "--threads", "1", "--without", "scale_search", "--without", "split"),
    *(word for stage in STAGES for word in ("--set", f"stages.{stage}.steps=1")),
    *("--set", "initial.surface_resolution=16", "--set", "object.n_gaussians=50"),
]


def build_corpus(folder: Path, clip: Path | None = None, run: Path | None = None) -> None:
    """Fill a folder with one subfolder for each target's files.

    Args:
        folder: to fill; made if missing.
        clip: a HOLD clip with its gt.npz, to be copied; one is made if not given.
        run: a finished run of it, likewise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    hands = load_hand_models(None)
    if clip is None:
        make_clip(folder / "clip", hand_models=hands, frames=5, width=64, height=48, seed=1)
    else:
        shutil.copytree(clip, folder / "clip", ignore=shutil.ignore_patterns("novel"))
    clip = folder / "clip"
    if run is None:
        run = folder / "whole"
        main(["reconstruct", str(clip), "--out", str(run), *SHORT, "--gt", str(clip / "gt.npz")])
    shutil.copytree(run / "arctic_preds", folder / "run" / "arctic_preds")
    for name in ("scene.safetensors", "config.yaml", "metrics.json"):
        shutil.copyfile(run / name, folder / "run" / name)
    (folder / "run_of_hands").mkdir()
    shutil.copyfile(run / "config.yaml", folder / "run_of_hands" / "config.yaml")
    hands_alone = replace(load_playback(run / "scene.safetensors"), object=None)
    save_playback(folder / "run_of_hands" / "scene.safetensors", hands_alone)
    _write_texts(folder, clip)
    _write_config(folder / "config", run / "config.yaml")
    _write_hand_models(folder / "hands", hands["right"])
    _write_layouts(folder, clip)
    _write_submission(folder)
    main(
        [
            "preprocess",
            "frames",
            str(clip / "build" / "image"),
            "--out",
            str(folder / "pictures"),
            "--focal",
            "100",
            "--count",
            "4",
        ]
    )


def _write_texts(folder: Path, clip: Path) -> None:
    """Cameras to render from, a batch, keypoints and clicks."""
    turned = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
    lens = {"fl_x": 60.0, "fl_y": 60.0, "cx": 12.0, "cy": 8.0, "w": 24, "h": 16}
    views = [{"frame_index": t, "transform_matrix": turned} for t in (0, 2)]
    _json(folder / "transforms" / "transforms.json", {**lens, "frames": views})
    entries = [
        {"clip": "../clip", "name": "first", "preset": "smoke", "set": ["seed=1"]},
        {
            "clip": "../clip",
            "name": "second",
            "preset": "smoke",
            "gt": "../clip/gt.npz",
            "without": ["lighting"],
        },
    ]
    document = {"defaults": {"without": ["smooth"]}, "clips": entries}
    for suffix in ("json", "yaml"):
        _json(folder / "manifest" / f"clips.{suffix}", document)
    (folder / "manifest" / "clips.csv").write_text(
        "clip,name,preset,set\n../clip,first,smoke,seed=1;checkpoint_every=50\n../clip,second,smoke,\n"
    )
    (folder / "manifest" / "clips.txt").write_text("# two clips\n../clip\n../clip # again\n")
    truth, K = np.load(clip / "gt.npz"), load_hold(clip).K
    rows = []
    for t in range(len(truth["right_joints"])):
        pixels = {side: truth[f"{side}_joints"][t] @ K.T for side in SIDES}
        rows.append(
            {side: [[*(p[:2] / p[2]).round(2).tolist(), 0.9] for p in pixels[side]] for side in SIDES}
        )
    _json(folder / "keypoints" / "keypoints.json", {"order": "mano", "frames": rows})
    prompt = {"points": [[20, 20, 1], [1, 1, 0]], "box": [4, 4, 40, 40]}
    _json(folder / "clicks" / "clicks.json", {"frames": {"0": {"object": prompt, "right": prompt}}})
    count = len(rows)
    turns = {
        "global_orient": truth["right_pose"][:, :3],
        "hand_pose": truth["right_pose"][:, 3:].reshape(-1, 15, 3),
    }
    camera = {"pred_cam_t_full": truth["right_trans"], "scaled_focal_length": 5000.0}
    np.savez(
        folder / "keypoints" / "hands.npz",
        **turns,
        **camera,
        frame=np.arange(count),
        right=np.ones(count),
        betas=np.repeat(truth["right_betas"][None], count, axis=0),
    )


def _write_config(folder: Path, file: Path) -> None:
    """The run's own settings, with a step in each stage."""
    document = yaml.safe_load(file.read_text())
    for stage in document["config"]["stages"]:
        if "steps" in stage:
            stage["steps"] = 1
    folder.mkdir()
    (folder / "config.yaml").write_text(yaml.safe_dump(document, sort_keys=False))


def _write_hand_models(folder: Path, hand: HandModel) -> None:
    """The built-in hand as MANO's files, both kinds."""
    fields = {
        "v_template": hand.v_template.double().numpy(),
        "f": hand.faces.numpy().astype(np.uint32),
        "shapedirs": hand.shapedirs.double().numpy(),
        "posedirs": hand.posedirs.double().numpy(),
        "weights": hand.lbs_weights.double().numpy(),
        "J_regressor": hand.J_regressor.double().numpy(),
        "kintree_table": np.stack([np.array([2**32 - 1, *hand.parents[1:]]), np.arange(16)]),
        "hands_mean": hand.hands_mean.double().numpy().ravel(),
        "tip_vertex_ids": hand.tip_vertex_ids.numpy(),
    }
    for kind in ("npz", "pkl"):
        (folder / kind).mkdir(parents=True)
    np.savez_compressed(folder / "npz" / "MANO_RIGHT.npz", **fields)
    (folder / "pkl" / "MANO_RIGHT.pkl").write_bytes(pickle.dumps(fields, protocol=2))


def _write_layouts(folder: Path, path: Path) -> None:
    """The clip as structure from motion leaves it, and its truth as data sets have it."""
    clip, hands = load_hold(path), load_hand_models(None)
    wrists = {side: hands[side].rest_wrist(track.betas) for side, track in clip.hands.items()}
    assert clip.object is not None
    still = replace(
        clip,
        hands={
            side: move_hand(track, clip.cam_from_world, wrists[side]) for side, track in clip.hands.items()
        },
        object=move_object(clip.object, clip.cam_from_world),
        cam_from_world=np.repeat(np.eye(4)[None], len(clip), axis=0),
    )
    write_colmap(folder / "colmap_text", still)
    write_nerfstudio(folder / "nerfstudio", still)
    shutil.copytree(folder / "colmap_text", folder / "colmap_binary")
    model = folder / "colmap_binary" / "sparse" / "0"
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    for file in model.glob("*.txt"):
        file.unlink()
    annotation = load_annotation(path)
    assert annotation.object is not None
    simple = trimesh.Trimesh(annotation.object.verts, annotation.object.faces, process=False).convex_hull
    few = replace(annotation.object, verts=np.asarray(simple.vertices), faces=np.asarray(simple.faces))
    annotation = replace(annotation, object=few)
    images = [clip.image(t) for t in range(len(clip))]
    write_arctic(folder / "arctic", annotation, subject="s01", sequence="box_grab_01", images=images)
    wrists = {side: hands[side].rest_wrist(track.betas) for side, track in annotation.hands.items()}
    write_ho3d(
        folder / "ho3d",
        in_world(annotation, np.linalg.inv(CV_FROM_GL), wrists),
        clip="SM1",
        object_name="006_mustard_bottle",
        images=images,
        hands_mean=hands["right"].hands_mean.double().numpy(),
    )


def _write_submission(folder: Path) -> None:
    """The run's predictions, packed; its folder then holds what other commands read."""
    predictions = folder / "run" / "arctic_preds"
    (name,) = (file.stem for file in predictions.iterdir())
    place = folder / "submission"
    place.mkdir()
    main(["submission", str(place / "preds.zip"), "--runs", str(folder / "run"), "--sequences", name])
    (place / "sequence").write_text(name)
    shutil.rmtree(predictions)


def _json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))

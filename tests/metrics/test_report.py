"""The whole report: perfect on the truth, known on known errors, as expected on a real clip."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from bigs.checks import InputError
from bigs.metrics.report import METRICS, comparison_table, evaluate, match_frames, per_frame, remarks
from bigs.types import HandObjectTrajectory

CLIPS, HAND_MODEL = os.environ.get("BIGS_CLIPS"), os.environ.get("BIGS_HAND_MODEL")


@pytest.fixture(scope="module")
def truth():
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    verts = np.asarray(mesh.vertices) * [1.0, 1.6, 0.6]
    path = np.array([0.0, 0.0, 0.7]) + np.cumsum(0.005 * rng.normal(size=(4, 3)), axis=0)
    return HandObjectTrajectory(
        name="clip",
        frame_names=("00100.jpg", "00101.jpg", "00102.jpg", "00103.jpg"),
        joints={
            side: path[:, None] + 0.05 * rng.normal(size=(4, 21, 3)) + [offset, 0.0, 0.0]
            for side, offset in (("right", -0.1), ("left", 0.1))
        },
        verts={},
        faces={},
        object_verts=path[:, None] + verts,
        object_faces=np.asarray(mesh.faces),
    )


def moved(clip, offset):
    """The clip with both hands shifted against the object."""
    return dataclasses.replace(clip, joints={side: joints + offset for side, joints in clip.joints.items()})


def test_the_truth_is_perfect(truth):
    scores = evaluate(truth, truth)
    assert set(scores) == set(METRICS)
    for key, metric in METRICS.items():
        perfect = {"lower": 0.0, "higher": 100.0, "neither": 1.0}[metric.better]
        # the aligned scores stop where ICP stops
        assert scores[key] == pytest.approx(perfect, abs=0.02 if "icp" in key else 1e-4), key


def test_wrist_and_relative_chamfer_of_a_known_offset(truth):
    scores = evaluate(moved(truth, [0.0, 0.0, 0.01]), truth)
    assert scores["mpjpe_ra_h"] == pytest.approx(0.0, abs=1e-9)
    assert scores["wrist_unscaled_r"] == pytest.approx(10.0)
    # one scale for the clip explains nearly all of a shift in depth
    assert scores["wrist_r"] < 3.0
    assert 0.3 < scores["cd_r"] <= 2.0
    assert scores["cd_r_sq"] == pytest.approx(scores["cd_l_sq"], rel=1e-6)
    assert scores["f10_icp"] == pytest.approx(100.0, abs=0.01)


def test_a_uniform_scale_of_the_clip_costs_no_wrist_error(truth):
    larger = dataclasses.replace(
        truth,
        joints={side: 1.25 * joints for side, joints in truth.joints.items()},
        object_verts=1.25 * truth.object_verts,
    )
    scores = evaluate(larger, truth)
    assert scores["clip_scale"] == pytest.approx(0.8)
    assert scores["wrist_h"] == pytest.approx(0.0, abs=1e-9)
    assert scores["f10_cam"] == pytest.approx(100.0, abs=0.01)
    assert scores["wrist_unscaled_r"] > 100.0


def test_frames_are_matched_by_name(truth):
    order = [2, 0, 3, 1]
    shuffled = dataclasses.replace(
        truth,
        frame_names=tuple(f"images/{truth.frame_names[i][:-4]}.png" for i in order),
        joints={side: joints[order] for side, joints in truth.joints.items()},
        object_verts=truth.object_verts[order],
    )
    frames = per_frame(shuffled, truth)
    assert np.allclose(frames["mpjpe_ra_r"], 0.0)
    assert np.allclose(frames["cd_r"], 0.0)


def test_per_frame_scores_average_to_the_clips(truth):
    pred = moved(truth, [0.01, 0.002, -0.01])
    frames, clip = per_frame(pred, truth), evaluate(pred, truth)
    assert all(values.shape == (4,) for values in frames.values())
    for key, values in frames.items():
        assert clip[key] == pytest.approx(values.mean())


def test_frames_without_truth_do_not_count(truth):
    pred = moved(truth, [0.01, 0.0, 0.0])
    pred.joints["right"][2] += 100.0
    holes = dataclasses.replace(
        truth,
        joints={side: joints.copy() for side, joints in truth.joints.items()},
        object_verts=truth.object_verts.copy(),
    )
    for values in (*holes.joints.values(), holes.object_verts):
        values[[0, 2]] = np.nan
    scores = evaluate(pred, holes)
    assert np.isfinite(list(scores.values())).all()
    assert scores["wrist_unscaled_r"] == pytest.approx(10.0)


def test_what_is_missing_has_no_score(truth):
    one_hand = dataclasses.replace(truth, joints={"right": truth.joints["right"]})
    scores = per_frame(one_hand, truth)
    assert "mpjpe_ra_r" in scores
    assert not any(key.endswith(("_l", "_h", "_l_sq", "_h_sq")) for key in scores)
    no_object = dataclasses.replace(truth, object_verts=None, object_faces=None)
    assert not any(key.startswith(("cd", "f5", "f10")) for key in evaluate(truth, no_object))
    assert evaluate(dataclasses.replace(truth, joints={}), truth)["clip_scale"] == pytest.approx(1.0)


def test_what_is_missing_is_told(truth):
    assert remarks(truth, truth) == {}
    one_hand = dataclasses.replace(truth, joints={"right": truth.joints["right"]})
    told = remarks(one_hand, truth)
    assert told["mpjpe_ra_l"] == told["cd_l_sq"] == told["mrrpe_l"] == "the result has no left hand"
    assert told["mpjpe_ra_h"] == "the result has no left hand" and "mpjpe_ra_r" not in told
    assert remarks(truth, one_hand)["wrist_l"] == "the truth has no left hand"
    assert remarks(one_hand, one_hand) == {}
    no_object = dataclasses.replace(truth, object_verts=None, object_faces=None)
    told = remarks(truth, no_object)
    assert told["cd_icp_sq"] == told["f5_cam"] == told["cd_r"] == "the truth has no object"
    table = comparison_table({"result": evaluate(truth, no_object)}, details=True, told=told)
    assert ("CD_o: the truth has no object", "cm²", "-") in table
    holes = dataclasses.replace(truth, joints={side: v.copy() for side, v in truth.joints.items()})
    holes.joints["left"][1] = np.nan
    told = remarks(truth, holes)
    assert told["mpjpe_ra_l"] == told["mpjpe_ra_h"] == told["cd_l"] == "3 of 4 frames"
    assert "mpjpe_ra_r" not in told and "cd_icp" not in told


@pytest.mark.parametrize("part", ["joints", "object"])
def test_one_value_that_is_no_number_is_named(truth, part):
    broken = dataclasses.replace(
        truth,
        joints={side: v.copy() for side, v in truth.joints.items()},
        object_verts=truth.object_verts.copy(),
    )
    values = broken.joints["left"] if part == "joints" else broken.object_verts
    values[2, 3, 1] = np.nan
    with pytest.raises(InputError, match=rf"prediction: .*{part}.*nan at index \[2, 3, 1\]"):
        evaluate(broken, truth)
    with pytest.raises(InputError, match=rf"ground truth: .*{part}.*point 3 of frame 2"):
        evaluate(truth, broken)


def test_frame_names_that_do_not_match_are_named():
    with pytest.raises(InputError, match=r"found no 'b' \(1 missing\)"):
        match_frames(("a.png",), ("a.png", "b.png"))
    with pytest.raises(InputError, match=r"found 2, among them 'b'"):
        match_frames(("a.png", "b.png"), ("a.png",))
    with pytest.raises(InputError, match="each name once, found 'a' again"):
        match_frames(("x/a.png", "y/a.png"), ("a.png", "b.png"))


def test_shapes_that_do_not_fit_are_named(truth):
    short = dataclasses.replace(truth, joints={"right": truth.joints["right"][:, :16]})
    with pytest.raises(
        InputError, match=r"prediction: joints of the right hand: expected shape \[4, 21, 3\]"
    ):
        evaluate(short, truth)


def test_comparison_table_puts_scores_side_by_side():
    table = comparison_table(
        {
            "initial": {"mpjpe_ra_r": 20.0, "f10_icp": 90.0, "cd_icp_sq": 0.1234},
            "result": {"mpjpe_ra_r": 10.0},
        }
    )
    assert table == [
        ("score", "unit", "initial", "result", "change"),
        ("MPJPE_r", "mm", "20.00", "10.00", "-50 %"),
        ("CD_o", "cm²", "0.123", "-", ""),
        ("F10", "%", "90.00", "-", ""),
    ]
    assert comparison_table({"result": {"f5_icp": 80.0}}) == [
        ("score", "unit", "result"),
        ("F5", "%", "80.00"),
    ]
    gain = comparison_table({"initial": {"f5_icp": 80.0}, "result": {"f5_icp": 82.5}})
    assert gain[1][-1] == "+2.5 points"


@pytest.mark.skipif(not (CLIPS and HAND_MODEL), reason="needs BIGS_CLIPS and BIGS_HAND_MODEL")
def test_initial_estimates_of_a_clip_score_as_expected():
    pred, gt = _initial_and_true(Path(CLIPS) / "dev_mustard", Path(HAND_MODEL))
    scores = evaluate(pred, gt)
    expected = {
        "mpjpe_ra_r": (21.2, 0.1),
        "mpjpe_ra_l": (26.0, 0.1),
        "wrist_unscaled_r": (41.0, 0.5),
        "wrist_unscaled_l": (36.0, 0.5),
        "wrist_r": (39.4, 0.1),
        "wrist_l": (26.1, 0.1),
        "cd_r_sq": (26.2, 0.5),
        "cd_l_sq": (9.7, 0.8),
        "f10_icp": (93.4, 1.5),
        "f5_icp": (83.6, 3.0),
    }
    for key, (value, tolerance) in expected.items():
        assert scores[key] == pytest.approx(value, abs=tolerance), key


def _initial_and_true(folder, hand_model):
    from bigs.unpickle import load_npy

    stored, gt = load_npy(folder / "build" / "data.npy"), np.load(folder / "gt.npz")
    flip, shift = np.array([1.0, -1.0, -1.0]), np.asarray(stored["normalize_shift"])
    pred_joints = {}
    for side in ("right", "left"):
        with np.load(hand_model / f"MANO_{side.upper()}.npz") as fields:
            model = {key: fields[key] for key in fields.files if key != "joint_names"}
        hand = stored["entities"][side]
        joints = [_joints(model, pose, hand["mean_shape"]) for pose in hand["hand_poses"]]
        pred_joints[side] = (np.stack(joints) + hand["hand_trans"][:, None] - shift) * flip
    found = stored["entities"]["object"]
    metric = np.linalg.inv(np.asarray(found["norm_mat"], dtype=np.float64))
    points = found["obj_scale"] * (np.asarray(found["pts.cano"]) @ metric[:3, :3].T + metric[:3, 3])
    rotations = Rotation.from_rotvec(found["object_poses"][:, :3]).as_matrix()
    placed = np.einsum("tij,nj->tni", rotations, points) + found["object_poses"][:, None, 3:]
    mesh = trimesh.load(folder / "gt_object.ply", process=False)
    true_object = (
        np.einsum("tij,nj->tni", gt["obj_R"], gt["obj_scale"] * mesh.vertices) + gt["obj_t"][:, None]
    )
    names = tuple((folder / "build" / "corres.txt").read_text().split())
    true_joints = {side: gt[f"{side}_joints"] for side in ("right", "left")}
    pred = HandObjectTrajectory("clip", names, pred_joints, {}, {}, (placed - shift) * flip, None)
    return pred, HandObjectTrajectory("clip", names, true_joints, {}, {}, true_object, np.asarray(mesh.faces))


def _joints(model, pose, betas):
    """16 posed joints and 5 posed tips of a MANO-form hand without translation."""
    shaped = model["v_template"] + model["shapedirs"] @ betas
    rest = model["J_regressor"] @ shaped
    parents = model["kintree_table"][0].astype(np.int64)
    rotations = Rotation.from_rotvec(
        (pose + np.r_[np.zeros(3), model["hands_mean"]]).reshape(16, 3)
    ).as_matrix()
    turned, posed = [rotations[0]], [rest[0]]
    for joint in range(1, 16):
        parent = parents[joint]
        posed.append(posed[parent] + turned[parent] @ (rest[joint] - rest[parent]))
        turned.append(turned[parent] @ rotations[joint])
    turned, posed = np.stack(turned), np.stack(posed)
    tips = model["tip_vertex_ids"]
    each_bone = np.einsum("jab,kjb->kja", turned, shaped[tips][:, None] - rest[None]) + posed
    return np.concatenate([posed, np.einsum("kj,kja->ka", model["weights"][tips], each_bone)])


def test_every_score_is_that_of_the_evaluators_formulas(truth):
    """A second writing of the definitions: loops over points, nothing shared with the code under test."""
    rng = np.random.default_rng(9)
    thin = dataclasses.replace(truth, object_verts=truth.object_verts[:, ::9], object_faces=None)
    pred = dataclasses.replace(
        thin,
        joints={side: joints + 0.01 * rng.normal(size=joints.shape) for side, joints in truth.joints.items()},
        object_verts=truth.object_verts[:, ::7] + 0.008 * rng.normal(size=(4, 1, 3)),
    )
    scores, frames = evaluate(pred, thin), per_frame(pred, thin)

    def sums(p, g):
        d1 = [100 * min(np.linalg.norm(a - b) for b in p) for a in g]
        d2 = [100 * min(np.linalg.norm(a - b) for b in g) for a in p]
        out = [np.mean(np.square(d1)) + np.mean(np.square(d2)), np.mean(d1) + np.mean(d2)]
        for limit in (0.5, 1.0):
            hit1, hit2 = np.mean(np.array(d1) < limit), np.mean(np.array(d2) < limit)
            out.append(100 * 2 * hit1 * hit2 / (hit1 + hit2 + 1e-7))
        return out

    def centre(verts):
        return (verts.min(axis=0) + verts.max(axis=0)) / 2

    expected = {key: [] for key in frames}
    for t in range(4):
        both = [(side.joints, side.object_verts[t]) for side in (pred, thin)]
        for side in ("right", "left"):
            s = side[0]
            (j_pred, o_pred), (j_gt, o_gt) = ((joints[side][t], verts) for joints, verts in both)
            error = np.linalg.norm((j_pred - j_pred[0]) - (j_gt - j_gt[0]), axis=1)
            expected[f"mpjpe_ra_{s}"].append(1000 * error.mean())
            squared, root, f5, f10 = sums(o_pred - j_pred[0], o_gt - j_gt[0])
            for key, value in (
                (f"cd_{s}_sq", squared),
                (f"cd_{s}", root),
                (f"f5_{s}", f5),
                (f"f10_{s}", f10),
            ):
                expected[key].append(value)
            gap = (centre(o_pred) - j_pred[0]) - (centre(o_gt) - j_gt[0])
            expected[f"mrrpe_{s}"].append(1000 * np.linalg.norm(gap))
        squared, _, f5, f10 = sums(*(verts - centre(verts) for _, verts in both))
        for key, value in (("cd_ra_sq", squared), ("f5_ra", f5), ("f10_ra", f10)):
            expected[key].append(value)
    for pair in ("mpjpe_ra_{}", "cd_{}_sq", "cd_{}"):
        expected[pair.format("h")] = np.mean([expected[pair.format("r")], expected[pair.format("l")]], axis=0)
    checked = [key for key, values in expected.items() if len(values)]
    assert len(checked) == 18
    for key in checked:
        np.testing.assert_allclose(frames[key], expected[key], rtol=1e-9, err_msg=key)
        assert scores[key] == pytest.approx(np.mean(expected[key])), key
    assert scores["cd_icp_arctic"] == min(scores["cd_icp_sq"], scores["cd_icp"])

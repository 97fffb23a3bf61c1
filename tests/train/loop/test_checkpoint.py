"""Checkpoints: an interrupted and resumed fit is the undisturbed one, bit for bit."""

from __future__ import annotations

import copy
import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor
from toy_scenes import cube_scene

from bigs.checks import InputError
from bigs.data.base import Clip
from bigs.hand import HandModel
from bigs.models.scene import Scene
from bigs.train.fit import fit
from bigs.train.fit_report import FitReport
from bigs.train.loop.checkpoint import FILE_NAME, load_checkpoint, save_checkpoint
from bigs.train.plan.config import GraspStage, OptimizeStage, RunConfig, Stage
from bigs.train.plan.presets import SMOKE
from bigs.train.resolve import resolve
from bigs.types import Side


def short_plan() -> RunConfig:
    """Every kind of stage of the smoke preset, four steps each, and one that is skipped.

    Three steps between checkpoints.
    """

    def short(stage: Stage) -> Stage:
        if isinstance(stage, OptimizeStage):
            return replace(stage, steps=4, image_size=40)
        # Hands hold the bottle all the time. Stricter grasps leave frames to the stage of those without.
        return replace(stage, excess=0.2) if isinstance(stage, GraspStage) else stage

    stages = [short(stage) for stage in copy.deepcopy(SMOKE.stages) if stage.name != "hands-fine"]
    never = replace(stages[0], name="never", weights={})
    return resolve(replace(SMOKE, stages=(never, *stages), checkpoint_every=3)).config


class Interrupted(Exception):
    pass


def interrupt_after(events: int) -> Any:
    """A listener that raises on the event after so many steps."""
    seen = 0

    def listen(event: dict[str, Any]) -> None:
        nonlocal seen
        if event["event"] == "step":
            seen += 1
            if seen == events:
                raise Interrupted

    return listen


@pytest.fixture(scope="module")
def whole(tiny: Clip, both_hands: dict[Side, HandModel]) -> tuple[Scene, FitReport]:
    return fit(tiny, both_hands, short_plan())


@pytest.fixture(scope="module")
def undisturbed(whole: tuple[Scene, FitReport]) -> dict[str, Tensor]:
    return whole[0].state_dict()


def assert_same(scene: Scene, expected: dict[str, Tensor]) -> None:
    found = scene.state_dict()
    assert found.keys() == expected.keys()
    differing = [name for name in expected if not torch.equal(found[name], expected[name])]
    assert not differing


def test_keeping_checkpoints_changes_nothing_and_a_finished_fit_is_not_run_again(
    tiny: Clip, both_hands: dict[Side, HandModel], undisturbed: dict[str, Tensor], tmp_path: Path
) -> None:
    scene, _ = fit(tiny, both_hands, short_plan(), checkpoints=tmp_path)
    assert_same(scene, undisturbed)
    assert [path.name for path in tmp_path.iterdir()] == [FILE_NAME]
    events: list[Any] = []
    scene, _ = fit(tiny, both_hands, short_plan(), checkpoints=tmp_path, resume=True, listen=events.append)
    assert_same(scene, undisturbed)
    assert [event["event"] for event in events] == ["resume"]


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 4, 5, 28])
def test_a_resumed_fit_is_the_undisturbed_one(
    tiny: Clip,
    both_hands: dict[Side, HandModel],
    undisturbed: dict[str, Tensor],
    tmp_path: Path,
    steps: int,
) -> None:
    """Interrupted before the first checkpoint, at one, between two, at a stage's end, and at the very end."""
    with pytest.raises(Interrupted):
        fit(tiny, both_hands, short_plan(), checkpoints=tmp_path, listen=interrupt_after(steps))
    torch.manual_seed(1234)  # the state of the process has no say
    done: list[int] = []
    scene, _ = fit(
        tiny,
        both_hands,
        short_plan(),
        checkpoints=tmp_path,
        resume=True,
        listen=lambda event: done.append(1) if event["event"] == "step" else None,
    )
    assert_same(scene, undisturbed)
    # Nothing that a checkpoint holds is done again.
    kept = 4 * ((steps - 1) // 4) + (3 if (steps - 1) % 4 == 3 else 0)
    assert len(done) == 28 - kept


@pytest.mark.slow
def test_interrupted_again_and_again(
    tiny: Clip, both_hands: dict[Side, HandModel], whole: tuple[Scene, FitReport], tmp_path: Path
) -> None:
    """The scene is the same, and the report has the stages that were over before the interruption."""
    for _ in range(8):
        try:
            scene, report = fit(
                tiny,
                both_hands,
                short_plan(),
                checkpoints=tmp_path,
                resume=True,
                listen=interrupt_after(5),
            )
        except Interrupted:
            continue
        break
    assert_same(scene, whole[0].state_dict())
    expected = whole[1]
    assert "never: no loss term is left" in expected.skipped
    assert report.skipped == expected.skipped
    assert list(report.seconds) == list(expected.seconds)
    assert 0 < report.before < sum(report.seconds.values())


def test_the_stopping_rule_survives_an_interruption(
    tiny: Clip, both_hands: dict[Side, HandModel], tmp_path: Path
) -> None:
    """Rates of nothing: the loss has settled after twice the patience, resumed or not.

    The report tells what the steps that were not taken would have cost, and fields that nothing trained.
    """
    still = replace(
        short_plan().stages[1],
        steps=30,
        lrs={"hand.ray": 1e-9},
        weights={"image": 1.0},
        frames_per_step=0,
        stop_patience=5,
    )
    config = replace(short_plan(), stages=(still,))
    steps: list[int] = []

    def listen(event: dict[str, Any]) -> None:
        if event["event"] == "step":
            steps.append(event["step"])
            if len(steps) == 5:
                raise Interrupted

    with pytest.raises(Interrupted):
        fit(tiny, both_hands, config, checkpoints=tmp_path, listen=listen)
    _, report = fit(tiny, both_hands, config, checkpoints=tmp_path, resume=True, listen=listen)
    assert steps == [1, 2, 3, 4, 5, 4, 5, 6, 7, 8, 9, 10]
    of_fields, of_pixels, of_steps = report.spared.values()
    assert 0.0 < of_fields < report.seconds[still.name]
    assert 0.0 < of_pixels < report.seconds[still.name]
    assert of_steps == pytest.approx(20 / 10 * report.seconds[still.name], rel=0.5)
    assert f"steps of stages whose loss had settled ({of_steps:.2g} s)" in report.facts["left out"]
    assert f"in all of its steps but one ({of_fields:.2g} s)" in report.facts["left out"]


def test_without_a_checkpoint_resuming_starts_anew(
    tiny: Clip, both_hands: dict[Side, HandModel], undisturbed: dict[str, Tensor], tmp_path: Path
) -> None:
    scene, _ = fit(tiny, both_hands, short_plan(), checkpoints=tmp_path / "none", resume=True)
    assert_same(scene, undisturbed)


# --- checkpoints of something else ---


@pytest.fixture(scope="module")
def kept(tiny: Clip, both_hands: dict[Side, HandModel], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    with pytest.raises(Interrupted):
        fit(tiny, both_hands, short_plan(), checkpoints=folder, listen=interrupt_after(4))
    return folder


def other_hands(hands: dict[Side, HandModel], buffer: str) -> dict[Side, HandModel]:
    changed = copy.deepcopy(hands)
    for model in changed.values():
        getattr(model, buffer).mul_(1.01)
    return changed


OTHER_CLIPS = ("name", "frame names", "hand pose", "hand position", "hand shape", "object pose")
OTHER_MODELS = ("v_template", "shapedirs", "lbs_weights")


@pytest.mark.parametrize("what", ["seed", "a rate", *OTHER_CLIPS, *OTHER_MODELS])
def test_a_checkpoint_of_another_run_is_refused(
    tiny: Clip, both_hands: dict[Side, HandModel], kept: Path, what: str
) -> None:
    """Whatever changes the result makes it another run."""
    clip, hands, config = tiny, both_hands, short_plan()
    right, obj = tiny.hands["right"], tiny.object
    assert obj is not None
    if what == "seed":
        config = replace(config, seed=1)
    elif what == "a rate":
        config.stages[-1].lrs["object.ray"] *= 2
    elif what == "name":
        clip = replace(clip, name="other")
    elif what == "frame names":
        clip = replace(clip, frame_names=tuple(f"x{name}" for name in clip.frame_names))
    elif what == "hand pose":
        changed = replace(right, hand_pose=right.hand_pose + 0.01)
        clip = replace(clip, hands={**clip.hands, "right": changed})
    elif what == "hand position":
        changed = replace(right, transl=right.transl + 0.01)
        clip = replace(clip, hands={**clip.hands, "right": changed})
    elif what == "hand shape":
        changed = replace(right, betas=right.betas + 0.1)
        clip = replace(clip, hands={**clip.hands, "right": changed})
    elif what == "object pose":
        clip = replace(clip, object=replace(obj, transl=obj.transl + 0.01))
    else:
        hands = other_hands(hands, what)
    before = (kept / FILE_NAME).read_bytes()
    with pytest.raises(InputError, match=r"latest\.safetensors: expected a checkpoint of this clip"):
        fit(clip, hands, config, checkpoints=kept, resume=True)
    assert (kept / FILE_NAME).read_bytes() == before


def test_a_checkpoint_of_other_images_is_refused(
    tiny: Clip, both_hands: dict[Side, HandModel], kept: Path, tmp_path: Path
) -> None:
    """The images decide the result as much as the estimates do."""
    brighter = tmp_path / "image"
    brighter.mkdir()
    paths = []
    for path in tiny.image_paths:
        paths.append(brighter / path.name)
        Image.open(path).point(lambda value: value // 2).save(paths[-1])
    clip = replace(tiny, image_paths=tuple(paths))
    with pytest.raises(InputError, match="expected a checkpoint of this clip"):
        fit(clip, both_hands, short_plan(), checkpoints=kept, resume=True)


@pytest.mark.parametrize("length", [0, 5, 100, -1])
def test_a_truncated_checkpoint_is_named(
    tiny: Clip, both_hands: dict[Side, HandModel], kept: Path, tmp_path: Path, length: int
) -> None:
    (tmp_path / FILE_NAME).write_bytes((kept / FILE_NAME).read_bytes()[:length])
    with pytest.raises(InputError, match="expected a checkpoint, found a damaged file") as caught:
        fit(tiny, both_hands, short_plan(), checkpoints=tmp_path, resume=True)
    assert str(tmp_path / FILE_NAME) in str(caught.value)


def test_changed_bits_are_found(both_hands: dict[Side, HandModel], tmp_path: Path) -> None:
    """Anywhere: in the header, in numbers, in what is said of the run."""
    scene = cube_scene(both_hands)
    save_checkpoint(tmp_path, scene, "abc", 2, None, {"seconds": {"first": 1.5}})
    whole = (tmp_path / FILE_NAME).read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    chance = random.Random(0)
    places = [chance.randrange(header) for _ in range(30)] + [
        chance.randrange(header, len(whole)) for _ in range(9)
    ]
    for place in [*places, whole.index(b"1.5"), len(whole) - 1]:
        changed = bytearray(whole)
        changed[place] ^= 1 << chance.randrange(8)
        (tmp_path / FILE_NAME).write_bytes(changed)
        with pytest.raises(InputError, match=r"latest\.safetensors: expected (a checkpoint, found|format)"):
            load_checkpoint(tmp_path, scene, "abc")


def test_another_format_is_named(both_hands: dict[Side, HandModel], tmp_path: Path) -> None:
    save_file({"x": torch.zeros(1)}, tmp_path / FILE_NAME)
    with pytest.raises(InputError, match="expected format bigs-checkpoint-5, found None"):
        load_checkpoint(tmp_path, cube_scene(both_hands), "digest")


def test_what_a_checkpoint_holds(both_hands: dict[Side, HandModel], tmp_path: Path) -> None:
    scene = cube_scene(both_hands)
    report = {"seconds": {"first": 1.5}, "skipped": ["a line"]}
    save_checkpoint(tmp_path / "new" / "folder", scene, "abc", 2, None, report)
    with safe_open(tmp_path / "new" / "folder" / FILE_NAME, framework="pt") as file:
        assert {key.removeprefix("scene.") for key in file.keys()} == scene.state_dict().keys()  # noqa: SIM118
        assert json.loads(file.metadata()["position"]) == {"stage": 2, "step": None}
    other = cube_scene(both_hands)
    assert load_checkpoint(tmp_path / "new" / "folder", other, "abc") == (2, None, report)
    assert_same(other, scene.state_dict())
    assert load_checkpoint(tmp_path, other, "abc") is None

"""Masks of a whole clip from a few clicks, with SAM 2's video model as transformers has it.

The weights are the user's: a local folder with config.json and model.safetensors. Nothing is downloaded.
Pictures are resized and normalised here, because the library's own classes for it need torchvision.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors import SafetensorError
from torch import Tensor

from bigs.checks import InputError
from bigs.data.images import read_image
from bigs.preprocess.masks.clicks import Click
from bigs.types import MASK_VALUES, Entity

# ImageNet's statistics, with which the model was trained.
_MEAN = torch.tensor([0.485, 0.456, 0.406])
_STD = torch.tensor([0.229, 0.224, 0.225])
# The prompt encoder's labels: a point beside the thing, a point on it, and the two corners of a box.
_BESIDE, _ON, _CORNERS = 0, 1, (2, 3)


def load_sam2(folder: Path) -> Any:
    """The video model in a folder, on the CPU.

    Raises:
        InputError: transformers is not installed, there is no such folder, or it holds no such model.
    """
    if not folder.is_dir():
        raise InputError(no_weights(folder))
    if not (folder / "config.json").is_file() or not any(folder.glob("*.safetensors")):
        names = ", ".join(sorted(path.name for path in folder.iterdir())[:6]) or "nothing"
        raise InputError(f"{folder}: expected config.json and model.safetensors, found {names}")
    try:
        from transformers import Sam2VideoModel
    except ImportError:
        raise InputError(
            f"{folder}: expected the extra 'segment' (pip install 'bigs[segment]') for SAM 2, found no "
            f"transformers "
            "that has it"
        ) from None
    from transformers.utils import logging

    logging.disable_progress_bar()
    try:
        loaded: Any = Sam2VideoModel.from_pretrained(
            str(folder), local_files_only=True, output_loading_info=True
        )
    except (OSError, ValueError, RuntimeError, KeyError, SafetensorError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(f"{folder}: expected a SAM 2 video model, found {reason}") from None
    model, told = loaded
    if told["missing_keys"]:
        # The library would continue with random numbers in their place.
        raise InputError(
            f"{folder}: expected all weights of a SAM 2 video model, found none for "
            f"{len(told['missing_keys'])} of its parts ({min(told['missing_keys'])}, ...)"
        )
    return model.eval()


def no_weights(folder: Path | None) -> str:
    """What to say of a folder that is not there."""
    return (
        f"{folder}: expected a folder with the weights of a SAM 2 video model (config.json and "
        "model.safetensors), found no such folder; give one, or masks of another tool with --masks"
    )


def segment_clip(
    model: Any,
    images: Sequence[Path],
    size: tuple[int, int],
    clicks: Mapping[Entity, Sequence[Click]],
    listen: Callable[[str], None] = lambda text: None,
) -> list[np.ndarray]:
    """Follow what was clicked through all frames, forwards and backwards.

    Args:
        model: a `Sam2VideoModel`.
        images: T frames.
        size: their width and height.
        clicks: on each thing, in one or more frames.
        listen: told how far it is.

    Returns:
        T label images [H, W] uint8; a pixel that several things claim goes to the highest score.
    """
    scores: dict[Entity, list[Tensor]] = {}
    # Things clicked in the same frames share the encoding of each picture.
    groups: dict[tuple[int, ...], list[Entity]] = {}
    for entity, prompts in clicks.items():
        groups.setdefault(tuple(sorted({click.frame for click in prompts})), []).append(entity)
    for frames, entities in groups.items():
        scores |= _follow(model, images, size, frames, {e: clicks[e] for e in entities}, listen)
    masks = []
    for t in range(len(images)):
        logits = torch.stack([_to_size(scores[entity][t], size) for entity in scores])
        best, owner = logits.max(dim=0)
        values = torch.tensor([MASK_VALUES[entity] for entity in scores], dtype=torch.uint8)
        masks.append(torch.where(best > 0, values[owner], 0).to(torch.uint8).numpy())
    return masks


@torch.inference_mode()
def _follow(
    model: Any,
    images: Sequence[Path],
    size: tuple[int, int],
    frames: tuple[int, ...],
    clicks: Mapping[Entity, Sequence[Click]],
    listen: Callable[[str], None],
) -> dict[Entity, list[Tensor]]:
    """Low-resolution logits [h, w] of each thing in each frame; -1 where the model was not asked."""
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    side = int(model.image_size)
    session = Sam2VideoInferenceSession(video_height=size[1], video_width=size[0], dtype=torch.float32)
    # Frames are decoded on demand: a minute of video at this size would fill the memory.
    session.processed_frames = _LazyFrames(images, side)
    ids = {entity: MASK_VALUES[entity] for entity in clicks}
    for entity, prompts in clicks.items():
        place = session.obj_id_to_idx(ids[entity])
        for click in prompts:
            session.add_point_inputs(place, click.frame, _point_inputs(click, size, side))
    found: dict[Entity, list[Tensor]] = {
        entity: [torch.full((1, 1), -1.0) for _ in images] for entity in clicks
    }

    def keep(output: Any) -> None:
        for entity, identity in ids.items():
            row = output.object_ids.index(identity)
            found[entity][output.frame_idx] = (
                output.pred_masks[row].float().reshape(output.pred_masks.shape[-2:])
            )

    for frame in frames:
        session.obj_with_new_inputs = list(ids.values())
        keep(model(inference_session=session, frame_idx=frame))
    names = " and ".join(clicks)
    for reverse in (False, True):
        outputs = model.propagate_in_video_iterator(session, start_frame_idx=frames[0], reverse=reverse)
        for output in outputs:
            keep(output)
            listen(f"{names}, frame {output.frame_idx} of {len(images)}")
    return found


def _point_inputs(click: Click, size: tuple[int, int], side: int) -> dict[str, Tensor]:
    """A click as the prompt encoder takes it: points and labels, a box as its two corners before them."""
    points = [*click.points]
    labels = [_ON if on else _BESIDE for on in click.on]
    if click.box is not None:
        points = [click.box[:2], click.box[2:], *points]
        labels = [*_CORNERS, *labels]
    scaled = np.array(points) * side / np.array(size)
    return {
        "point_coords": torch.tensor(scaled, dtype=torch.float32)[None, None],
        "point_labels": torch.tensor(labels, dtype=torch.int32)[None, None],
    }


def _to_size(logits: Tensor, size: tuple[int, int]) -> Tensor:
    """Logits [h, w] at the frames' size [H, W]."""
    resized = torch.nn.functional.interpolate(
        logits[None, None], (size[1], size[0]), mode="bilinear", align_corners=False
    )
    return resized[0, 0]


class _LazyFrames(dict[int, Tensor]):
    """The model's pictures by number, [3, S, S], each decoded when it is asked for."""

    def __init__(self, images: Sequence[Path], side: int) -> None:
        super().__init__()
        self.images = images
        self.side = side

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> Tensor:
        picture = Image.fromarray(read_image(self.images[index]))
        pixels = np.asarray(picture.resize((self.side, self.side), Image.Resampling.BILINEAR))
        scaled = torch.from_numpy(pixels.copy()).float() / 255.0
        return ((scaled - _MEAN) / _STD).permute(2, 0, 1)

"""DISK features and LightGlue matches instead of SIFT, from weight files that the user has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.feature import DISK, LightGlue
from PIL import Image

from bigs.checks import InputError
from bigs.files import open_regular
from bigs.motion.features import NOTHING, FeatureConfig, FrameFeatures, crop_box, enlargement
from bigs.torch_files import load_torch

# DISK's network halves its input four times.
_MULTIPLE = 16


class LearnedMatcher(NamedTuple):
    """Both networks, with weights, ready to use."""

    disk: DISK
    glue: LightGlue


def load_matcher(disk_file: Path, glue_file: Path) -> LearnedMatcher:
    """Networks with the weights of two files as their authors published them.

    Args:
        disk_file: DISK's, a state dict, alone or under `extractor`.
        glue_file: LightGlue's for DISK, a state dict.

    Raises:
        InputError: a file is missing or damaged, or holds other weights.
    """
    disk = DISK()
    stored = _read_weights(disk_file)
    inside = stored.get("extractor", stored)
    _load(disk, inside if isinstance(inside, Mapping) else stored, disk_file)
    # LightGlue fetches weights by itself unless it is told of no features.
    glue = LightGlue(None, input_dim=128, weights=None)  # type: ignore[arg-type]
    renamed = {_present_name(str(name)): value for name, value in _read_weights(glue_file).items()}
    _load(glue, renamed, glue_file)
    return LearnedMatcher(disk.eval(), glue.eval())


@torch.no_grad()
def extract_learned(
    images: Sequence[np.ndarray], masks: np.ndarray, matcher: LearnedMatcher, config: FeatureConfig
) -> list[FrameFeatures]:
    """DISK's features on the pixels where `masks` [T, H, W] is true, each frame's crop enlarged."""
    boxes = [crop_box(mask) for mask in masks]
    scale = enlargement(boxes, config)
    return [
        NOTHING if box is None else _extract(image, mask, box, scale, matcher.disk, config)
        for image, mask, box in zip(images, masks, boxes, strict=True)
    ]


@torch.no_grad()
def match_learned(
    features: Sequence[FrameFeatures],
    pairs: Sequence[tuple[int, int]],
    size: tuple[int, int],
    matcher: LearnedMatcher,
) -> dict[tuple[int, int], np.ndarray]:
    """LightGlue's matches [n, 2] of pairs of frames of `size` (width, height), not verified yet."""
    found = {}
    for a, b in pairs:
        if min(len(features[a].pixels), len(features[b].pixels)) >= 2:
            given = {f"image{i}": _as_input(features[t], size) for i, t in enumerate((a, b))}
            found[a, b] = matcher.glue(given)["matches"][0].numpy().astype(int).reshape(-1, 2)
    return found


def _extract(
    image: np.ndarray,
    mask: np.ndarray,
    box: tuple[int, int, int, int],
    scale: float,
    disk: DISK,
    config: FeatureConfig,
) -> FrameFeatures:
    top, bottom, left, right = box
    crop = Image.fromarray(image[top:bottom, left:right])
    size = (max(round(crop.width * scale), _MULTIPLE), max(round(crop.height * scale), _MULTIPLE))
    large = np.asarray(crop.resize(size, Image.Resampling.BICUBIC), dtype=np.float32) / 255.0
    found = disk(
        torch.from_numpy(large).permute(2, 0, 1)[None], n=config.max_features, pad_if_not_divisible=True
    )[0]
    factor = (size[0] / crop.width, size[1] / crop.height)
    # The network's first pixel has its centre at 0.
    pixels = (found.keypoints.double().numpy() + 0.5) / factor + (left, top)
    column, row = np.floor(pixels).astype(int).T
    inside = mask[row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)]
    count = int(inside.sum())
    # The search for points expects descriptors of SIFT's length.
    descriptors = torch.nn.functional.normalize(found.descriptors, dim=-1).numpy() * 512.0
    return FrameFeatures(
        pixels[inside], np.full(count, 1.0 / factor[0]), np.zeros(count), descriptors[inside]
    )


def _as_input(features: FrameFeatures, size: tuple[int, int]) -> dict[str, torch.Tensor]:
    return {
        "keypoints": torch.as_tensor(features.pixels, dtype=torch.float32)[None],
        "descriptors": torch.as_tensor(features.descriptors, dtype=torch.float32)[None] / 512.0,
        "image_size": torch.tensor([size], dtype=torch.float32),
    }


def _read_weights(file: Path) -> Mapping[str, Any]:
    with open_regular(file, "a file of weights") as stream:
        stored = load_torch(str(file), stream, "weights that torch reads")
    if not isinstance(stored, Mapping):
        raise InputError(f"{file}: expected a dictionary of weights, found {type(stored).__name__}")
    return stored


def _present_name(name: str) -> str:
    """A parameter's name in kornia, from that in the authors' file, whose layers are sorted by kind."""
    kind, _, rest = name.removeprefix("matcher.").partition(".")
    number, _, rest_of_name = rest.partition(".")
    if kind in ("self_attn", "cross_attn") and number.isdigit():
        return f"transformers.{number}.{kind}.{rest_of_name}"
    return name.removeprefix("matcher.")


def _load(network: torch.nn.Module, weights: Mapping[str, Any], file: Path) -> None:
    wanted = {name for name, _ in network.named_parameters()}
    missing = sorted(wanted - set(weights))
    if missing:
        raise InputError(
            f"{file}: expected the weights of {type(network).__name__}, found none for {missing[0]} "
            f"({len(missing)} of {len(wanted)} are missing)"
        )
    try:
        network.load_state_dict(dict(weights), strict=False)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise InputError(f"{file}: expected the weights of {type(network).__name__}: {reason}") from None

"""What a checkpoint belongs to."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace

import bigs
from bigs.data.base import Clip
from bigs.guidance.denoiser import Denoiser
from bigs.losses.perceptual import VggWeights
from bigs.models.scene import Scene
from bigs.train.plan.config import RunConfig


def run_digest(
    clip: Clip,
    scene: Scene,
    config: RunConfig,
    perceptual: VggWeights | None,
    denoiser: Denoiser | None,
) -> str:
    """Identifies what a checkpoint belongs to: version, configuration, images, masks and start values."""
    # The content of a network counts, not its path.
    prior = replace(config.prior, weights="", controlnet="", token="", edge_weights="")
    config = replace(config, perceptual_weights=(), prior=prior)
    origin = None if denoiser is None else denoiser.fingerprint
    text = json.dumps(
        [bigs.__version__, clip.name, list(clip.frame_names), asdict(config), origin], sort_keys=True
    )
    digest = hashlib.sha256(text.encode())
    for path in (*clip.image_paths, *clip.mask_paths):
        digest.update(path.read_bytes())
    # Parameters hold the fields' random start; buffers hold poses, surface and the hand model.
    network = () if perceptual is None else perceptual.tensors()
    for values in (*scene.parameters(), *scene.buffers(), *network):
        digest.update(values.detach().numpy().tobytes())
    return digest.hexdigest()[:16]

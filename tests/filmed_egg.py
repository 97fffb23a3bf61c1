"""Pictures of a turning egg with a texture of waves, each ray met exactly."""

from __future__ import annotations

import numpy as np
from turning_object import AXES, K, TurningObject

HEIGHT, WIDTH = 360, 480


def film(egg: TurningObject) -> tuple[list[np.ndarray], np.ndarray]:
    """Pictures of all frames, in light that fades by a hundredth a frame, and where the egg is [T, H, W]."""
    shown = [
        picture(rotation, transl, 1.0 - 0.01 * t)
        for t, (rotation, transl) in enumerate(zip(egg.rotations, egg.transl, strict=True))
    ]
    return [image for image, _ in shown], np.stack([on for _, on in shown])


def picture(rotation: np.ndarray, transl: np.ndarray, light: float) -> tuple[np.ndarray, np.ndarray]:
    """The egg with a texture of waves in space, [H, W, 3] uint8, and where it is [H, W]."""
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], np.ones_like(row)], axis=-1)
    eye, ray = -(rotation.T @ transl) / AXES, (rays @ rotation) / AXES
    a, b, c = (ray**2).sum(-1), (ray * eye).sum(-1), (eye**2).sum() - 1.0
    root = b**2 - a * c
    on = root > 0
    depth = (-b[on] - np.sqrt(root[on])) / a[on]
    place = (eye + depth[:, None] * ray[on]) * AXES
    rng = np.random.default_rng(4)
    waves = rng.standard_normal((40, 3))
    waves *= (2.0 * np.pi / rng.uniform(0.007, 0.03, 40) / np.linalg.norm(waves, axis=1))[:, None]
    texture = np.sin(place @ waves.T + rng.uniform(0.0, 6.0, 40)).sum(-1) / np.sqrt(40.0)
    grey = np.full((HEIGHT, WIDTH), 30.0)
    grey[on] = light * (120.0 + 50.0 * texture)
    return np.repeat(grey.round().clip(0, 255).astype(np.uint8)[..., None], 3, axis=2), on

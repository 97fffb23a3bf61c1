"""How fast a clip's hands and object move from one frame to the next, whatever rate the clip says it has.

Frames that were taken from a video, numbered anew and said to be 30 a second are the usual case of a wrong
rate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bigs.data.base import Clip
from bigs.threads import side_by_side
from bigs.types import MASK_VALUES, USUAL_FPS, Entity

# Median acceleration of what hands handle, in metres for a frame's time squared at `USUAL_FPS`; 0.6 m/s^2.
_USUAL_ACCELERATION = 0.7e-3
# A clip's rate is believed down to this share of it: people move at different speeds.
_BELIEVED = 2 / 3
# Second differences over two frames, of fewer of which a median says little.
_LEAST = 12
# Long side in pixels at which the middles of masks are found.
_SIZE = 240


def with_pace(clip: Clip) -> Clip:
    """The clip with its `pace` and a note of it, where that is clearly slower than its rate.

    The middles of masks tell how hands and object accelerate; estimates are too noisy for it. The calmest of
    them counts: hands that reach for something are fast at any rate, and the middle of what others hide in
    part jumps.

    Args:
        clip: with masks, and with estimates that tell distances.
    """
    if not clip.mask_paths:
        return clip
    step = max(1, -(-max(clip.width, clip.height) // _SIZE))
    frames = side_by_side(lambda t: _middles(clip.mask(t)[::step, ::step]), range(len(clip)))
    accelerations = []
    for entity, distance in _distances(clip).items():
        places = np.array([middles[entity] for middles in frames]) * step * distance / clip.K[0, 0]
        found = _acceleration(places)
        if found is not None:
            accelerations.append(found)
    pace = USUAL_FPS * np.sqrt(_USUAL_ACCELERATION / max(min(accelerations, default=0.0), 1e-9))
    if pace >= _BELIEVED * clip.fps:
        return clip
    note = (
        f"frames a second: {clip.fps:.3g}, yet hands and object move from frame to frame as they usually do "
        f"at {pace:.0f}; the plan allows for it (bigs convert --fps states a clip's rate)"
    )
    return replace(clip, pace=float(pace), notes=(*clip.notes, note))


def _middles(labels: np.ndarray) -> dict[Entity, np.ndarray]:
    """The mean pixel [2] of each entity in a mask; not a number where it isn't seen."""
    middles = {}
    for entity, value in MASK_VALUES.items():
        pixels = np.argwhere(labels == value)
        middles[entity] = pixels.mean(0) if len(pixels) else np.full(2, np.nan)
    return middles


def _distances(clip: Clip) -> dict[Entity, float]:
    """Usual depth of hands and object in front of the camera, in metres."""
    places: dict[Entity, np.ndarray] = {side: track.transl for side, track in clip.hands.items()}
    if clip.object is not None:
        places["object"] = clip.object.rotations @ clip.object.middle() + clip.object.transl
    to_cam = clip.cam_from_world[:, 2]
    return {
        entity: float(np.median(np.einsum("tj,tj->t", to_cam[:, :3], place) + to_cam[:, 3]))
        for entity, place in places.items()
    }


def _acceleration(places: np.ndarray) -> float | None:
    """The median length of second differences of places [T, 2], less what noise adds to them.

    Noise of single frames adds to differences over one frame and over two alike; even acceleration makes the
    latter four times as long.
    """
    lengths = []
    for lag in (1, 2):
        differences = places[2 * lag :] - 2 * places[lag:-lag] + places[: -2 * lag]
        differences = differences[np.isfinite(differences).all(1)]
        if len(differences) < _LEAST:
            return None
        lengths.append(np.median(np.linalg.norm(differences, axis=1)))
    one, two = lengths
    return float(np.sqrt(max(two**2 - one**2, 0.0) / 15))

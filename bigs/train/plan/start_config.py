"""How start values are found, and how the object is completed by its symmetries."""

from __future__ import annotations

from dataclasses import dataclass, field

from bigs.geometry.symmetry_search import SymmetryConfig


@dataclass(frozen=True)
class InitialConfig:
    """How the clip's estimates become start values."""

    # Width in frames of the robust smoothing of hand and object poses; more than about 2 blurs re-grasps.
    smooth_hands: float = 2.0
    smooth_object: float = 2.0
    # Weight of a frame that the estimator interpolated.
    interpolated_trust: float = 0.1
    # Cells along the longest side of the grid on which the object's surface is computed.
    surface_resolution: int = 80
    # Distance at which a point's plane loses all influence against the visual hull, metres.
    surface_reach: float = 0.016
    # Frames that must agree before a place is carved away, since single masks and poses are wrong.
    surface_agreeing: int = 3
    # The surface may exceed the points' convex hull by this much, metres, and on sides that no camera looked
    # at by as much as the masks ask for: each millimetre must explain a strip along the whole outline, on
    # average over the frames, that is this many millimetres wide.
    surface_margin: float = 0.002
    surface_price: float = 0.006
    # Surface counts as seen if it shows in this many frames: fewer may be an error of a mask or pose.
    seen_frames: int = 3
    # Typical error of poses, metres: nearer surface does not occlude, and space nearer than this is not known
    # to be empty.
    seen_tolerance: float = 0.006
    # Surface further than this from any seen or measured one is a guess, metres. If more than this share of
    # the surface is a guess and no symmetry supports it, contact ignores it, since closing what was never
    # seen fills a grip that a hand is in.
    surface_solid: float = 0.015
    surface_guessed: float = 0.1
    # The surface is smoothed over this many cells of its grid: errors of points and masks make it rough,
    # and Gaussians on a rough surface look torn from other views.
    surface_smoothing: float = 1.0
    # The mesh ends this far from any seen or measured surface, metres.
    surface_kept: float = 0.03


@dataclass(frozen=True)
class CompletionConfig:
    """When unseen parts are completed by symmetry. Lengths in metres."""

    symmetry: SymmetryConfig = field(default_factory=SymmetryConfig)
    # Nothing is completed if this share of the surface was seen.
    enough: float = 0.9
    # Seen surface supports a symmetry only this near to a point: elsewhere it may belong to the hull alone.
    measured: float = 0.008
    # A carried point is new if it is further than this from all others.
    gap: float = 0.003

"""How an object's tracks are found and weighed against the poses that were given."""

from __future__ import annotations

from dataclasses import dataclass, field

from bigs.motion.features import FeatureConfig
from bigs.motion.focal import FocalConfig
from bigs.motion.follow import FollowConfig
from bigs.motion.models import MappingConfig
from bigs.motion.object_map import MapConfig
from bigs.motion.patches import PatchConfig


@dataclass(frozen=True)
class TrackerConfig:
    """How tracks are found and weighed."""

    # Poses are roughly known, so half as many features suffice, and patches locate them again in any case.
    features: FeatureConfig = field(default_factory=lambda: FeatureConfig(first_octave=0))
    matching: MappingConfig = field(default_factory=MappingConfig)
    follow: FollowConfig = field(default_factory=FollowConfig)
    map: MapConfig = field(default_factory=MapConfig)
    patches: PatchConfig = field(default_factory=lambda: PatchConfig(passes=2))
    focal: FocalConfig = field(default_factory=FocalConfig)
    # Each frame is matched with this many later ones, ...
    overlap: int = 6
    # ... and with up to this many others whose rotation differs by less than this, degrees.
    alike: int = 3
    alike_angle: float = 25.0
    # An observation contradicts its frame's given pose if it is off by this many times the usual error and by
    # this many pixels.
    contradiction: float = 4.0
    least_contradiction: float = 8.0
    # Frames that share features differ by no more than this rotation, degrees.
    most_turned: float = 50.0
    # Factors on the map's scales in pixels, starting from the given poses' errors.
    reaches: tuple[float, ...] = (8.0, 3.0, 1.0)
    rounds: int = 1
    # Prior errors of given poses: degrees, and shares of the depth, across the ray and along it.
    turn_sigma: float = 3.0
    shift_sigma: tuple[float, float] = (0.015, 0.03)
    # Given poses are not thought to err by more than this, degrees, however far tracks leave them: marks that
    # are alike slide along a handle together, and then it is tracks that err.
    most_turn_sigma: float = 2.0
    # Errors of observations are correlated: true errors are about this many times those of independent ones.
    caution: float = 3.0
    # Up to this factor where poses leave the given ones for long by this many of their standard deviations.
    most_caution: float = 48.0
    most_departure: float = 2.5
    # Errors of neighbouring given poses are correlated too: smoothing them alone makes them no more certain.
    given_caution: float = 3.0
    # A frame with fewer observations says nothing about the given poses' errors.
    least_observations: int = 30

"""The configuration of a run: frozen values that travel once, downward. Presets are in `presets.py`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from bigs.models.hand_splats import HandSplatsConfig
from bigs.models.object_splats import ObjectSplatsConfig
from bigs.motion.tracker_config import TrackerConfig
from bigs.raster.settings import RasterSettings
from bigs.train.plan.densify_config import DensifyConfig
from bigs.train.plan.start_config import CompletionConfig, InitialConfig

StepKind = Literal["single-subject", "interacting-subjects"]


@dataclass(frozen=True)
class OptimizeStage:
    """One stage of gradient descent: what may change, which terms it minimises, and for how long."""

    name: str
    # The paper's two steps: every subject rendered alone, or all together.
    step: StepKind
    steps: int
    # Trainable groups (see `optim.GROUPS`) and their learning rates; a group that is not listed is frozen.
    lrs: dict[str, float]
    # Loss terms (see `terms.TERMS`) and their weights; a term that is not listed is not computed.
    weights: dict[str, float]
    # Long side in pixels to which this stage shrinks the clip's images; 0 keeps their size.
    image_size: int = 0
    # How many frames share one evaluation of the canonical fields; 0 takes the whole clip.
    frames_per_step: int = 0
    # Only frames in which a hand holds nothing, for each hand; frames of its grasps stay as they are.
    free_frames: bool = False
    # A frame that a step does not look at keeps its rotations and fingers, and their Adam moments.
    frame_moments: bool = False
    # Learning rates fall to this share, along a cosine or by the same factor in every step.
    final_lr: float = 0.1
    decay: Literal["cosine", "exponential"] = "cosine"
    # Adam's two decays. With the usual 0.9 poses overshoot and swing about their place for dozens of steps;
    # with the usual 0.999 a stage of hundreds of steps still remembers its first.
    adam_betas: tuple[float, float] = (0.8, 0.99)
    # Stop if the mean loss of `stop_patience` steps differs by less than `stop_gain` (relative) from that of
    # as many before; 0: never. For stages that look at the whole clip in every step: others waver.
    stop_patience: int = 0
    stop_gain: float = 0.005
    # Clone, split and prune the object's Gaussians during the stage; None keeps their number.
    densify: DensifyConfig | None = None


@dataclass(frozen=True)
class ScaleSearchStage:
    """The object's size by a one-dimensional search over contact."""

    name: str = "object-scale-search"
    step: StepKind = "interacting-subjects"
    # Relative sizes to try: `candidates` values evenly spaced in 1 - span ... 1 + span.
    span: float = 0.14
    candidates: int = 29
    # Contact cannot tell an object in front of a palm from one behind it, but occlusion can: weight, image
    # size and number of frames of the label term.
    labels_weight: float = 2.0
    image_size: int = 100
    frames: int = 12


@dataclass(frozen=True)
class GraspStage:
    """Grasps: from here on the object carries a hand while it holds on (see `train.grasps.find`)."""

    name: str = "grasps"
    step: StepKind = "interacting-subjects"
    # A frame outside grasps costs as much as a frame in a grasp with this squared error, in standard
    # deviations; a grasp costs as much as a few frames outside, so that five frames can form one. Each of its
    # ends costs half of that: the clip's border is none, and what it cuts off may be three frames long.
    free: float = 3.0
    grasp: float = 8.0
    # Fewest frames of a grasp between two moves.
    least: int = 4
    # Fewest frames between two grasps: nobody lets go and grasps again within a sixth of a second.
    gap: int = 5
    # Errors of estimates across and along the view, as standard deviations per metre of distance: an outline
    # tells the position to a few millimetres, and its size the distance to a few per cent.
    error_aside: float = 0.007
    error_along: float = 0.03
    # Disagreement with the masks, in squared error per pixel of the hand beyond that of the frame's own
    # estimate, that costs as much as a frame outside: about a third of the hand beside its mask.
    excess: float = 0.4
    # Long side in pixels at which masks are compared, and how often grasps are carried and cut again.
    image_size: int = 160
    rounds: int = 2
    # A hand that changes its grasp within this many frames turns evenly from one to the next.
    longest_move: int = 16
    # Estimators err alike in frames that are so near each other (see `find.carried_errors`).
    alike: float = 10.0
    # Factor on the residuals that a frame of a grasp adds to it; 0 makes grasps rigid.
    slack: float = 0.1


@dataclass(frozen=True)
class GraspDepthStage:
    """Depths of grasps, and the object's size, by where fingers touch (see `train.grasps.depth_search`)."""

    name: str = "grasp-depths"
    step: StepKind = "interacting-subjects"
    # Distances and sizes to try: the logarithms of `candidates` factors, evenly spaced in -span ... span.
    span: float = 0.18
    candidates: int = 37
    # Metres at which a gap to the surface counts half, and what it costs if the fingers reach nothing, and as
    # much again if nothing of the hand does: a negative log-likelihood, that of an error of four deviations.
    reach: float = 0.02
    weight: float = 8.0
    # Errors of a hand's place across and along the view, as standard deviations per metre of distance. Along
    # it, an outline of which a mask shows a part tells the less, down to what estimates tell.
    error_aside: float = 0.007
    error_along: float = 0.012
    error_hidden: float = 0.08
    # Error of the object's size, relative.
    size_error: float = 0.05
    # Long side in pixels at which masks are compared with hands.
    image_size: int = 160


@dataclass(frozen=True)
class MoveStage:
    """Frames between grasps in a wrong pose try those of their neighbours (see `train.moves.search`)."""

    name: str
    # Rates and weights of terms, as in `OptimizeStage`, of poses on trial. A mismatch of outlines counts 1.
    lrs: dict[str, float]
    weights: dict[str, float]
    step: StepKind = "single-subject"
    image_size: int = 160
    # Frames are tried again if their outlines disagree by more than this many times as much as usual, which
    # is no less than outlines disagree that are a third of a pixel apart.
    worse: float = 2.0
    exact: float = 0.01
    # Radians by which neighbours' poses are turned either way: fingers lie so far apart, seen from the wrist.
    turn: float = 0.25
    # Steps of every trial, and the steps that then follow for so many of each frame's best.
    trial_steps: tuple[int, int] = (15, 30)
    best: int = 2
    # A trial must bring the price below this share of what it was; and how often frames try.
    gain: float = 0.9
    rounds: int = 6
    # At most so many frames at either end of a grasp may leave it: if the outline disagrees by more than
    # `loose` times as much as usual, and the price of another pose is below `loose_gain` of that.
    loose_frames: int = 2
    loose: float = 2.5
    loose_gain: float = 0.5


@dataclass(frozen=True)
class ObjectMotionStage:
    """The object's motion from tracks in its pictures, found before anything is built on it.

    See `motion.tracker_config`. It is the first stage of a plan that has it.
    """

    name: str = "object-motion"
    step: StepKind = "single-subject"
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    # A camera whose exposure wavers sets itself, and few of those are calibrated: the chance that the given
    # focal length was is no more than this.
    calibrated_automatic: float = 0.5


@dataclass(frozen=True)
class SplitStage:
    """Evaluate the fields a last time and continue with free Gaussians (see `models.free_gaussians`)."""

    name: str = "split"
    step: StepKind = "single-subject"
    # Each Gaussian of the object that pictures show is split into parts x parts smaller ones.
    parts: int = 2
    # Parts are so many times as wide as their share of the surface: those of different Gaussians stand
    # unevenly, and other views would look through the gaps.
    overlap: float = 1.5
    # Whether the hands leave their field too.
    hands: bool = True
    # Gaussians of the object less opaque than this are pruned.
    least_opacity: float = 0.05


@dataclass(frozen=True)
class RefineStage:
    """Split the object's free Gaussians where pictures show more than they can; prune what is transparent.

    See `train.loop.refinement`.
    """

    name: str = "refine"
    step: StepKind = "single-subject"
    # Larger side of the pictures that say so, in pixels; 0 for the clip's own size.
    image_size: int = 480
    # The Gaussians split are the fewest that hold this share of the error that finer ones could explain, ...
    error_share: float = 0.9
    # ... each into parts x parts smaller ones.
    parts: int = 2
    # Gaussians less opaque than this are pruned.
    least_opacity: float = 0.05


# How to complete the object where no frame shows it.
PriorKind = Literal["off", "symmetry", "trained", "sd"]


@dataclass(frozen=True)
class PriorConfig:
    """What completes the object where it was never seen: each kind does what those before it do, and more.

    `trained` is a file of bigs prior train, `sd` Stable Diffusion with what belongs to it.
    """

    kind: PriorKind = "off"
    weights: str = ""  # the file, or Stable Diffusion's folder or hub name
    object_name: str = "object"  # for Stable Diffusion's prompts
    controlnet: str = ""  # folder or hub name of a soft-edge ControlNet
    token: str = ""  # file of bigs prior fit
    edge_weights: str = ""  # PiDiNet's file
    completion: CompletionConfig = field(default_factory=CompletionConfig)


@dataclass(frozen=True)
class CompletionStage:
    """The object's symmetries complete it where it was never seen (see `train.unseen.symmetry_stage`).

    With the prior off there is no such stage.
    """

    name: str = "object-completion"
    step: StepKind = "single-subject"
    # Undo everything if the error of the clip's own frames grows by more than this share.
    most_worsening: float = 0.005


@dataclass(frozen=True)
class GuidanceStage:
    """A diffusion prior completes the object where it was never seen (Eq. 7; see `train.unseen.prior_stage`).

    Without a prior's weights, or where the clip saw all of the object, there is no such stage.
    """

    name: str = "object-prior"
    step: StepKind = "single-subject"
    steps: int = 300
    # Virtual views per step, and their size in pixels.
    views: int = 4
    image_size: int = 64
    # Learning rates: metres along the normal, and logarithms or logits.
    lr_shift: float = 5e-4
    lr_size: float = 0.01
    lr_opacity: float = 0.02
    lr_color: float = 0.05
    # Weight of the smoothness of neighbours' shifts.
    smooth: float = 0.01
    # Range of timesteps at the start and at the end, as shares of the prior's schedule.
    t_first: tuple[float, float] = (0.5, 0.98)
    t_last: tuple[float, float] = (0.02, 0.3)
    # Skip the stage if this share of the object was seen, and views of which this share was seen.
    enough: float = 0.9
    well_seen: float = 0.85
    # Undo everything if the error of the seen part, or the object's area outside its mask in any frame, grows
    # by more than this share.
    damage: float = 0.02
    # Weight per pixel of what the clip's frames now show differently than at the stage's start.
    frame_weight: float = 0.3
    # Leave out a prior whose error on the seen part is this many times its error on its own meshes.
    unlike: float = 1.2


@dataclass(frozen=True)
class OpeningConfig:
    """When the object's mesh is opened where something is seen through it (see `train.unseen.openings`)."""

    # A hand or point that shows further than this behind the surface is seen through it, metres: more than a
    # hand's depth is usually wrong by.
    depth: float = 0.012
    # Frames that must show it, which must be this share of all for hands and this for points, of which a few
    # are always wrong; and the least area of what they prove to be open, square metres.
    frames: int = 5
    share: float = 0.08
    points_share: float = 0.16
    area: float = 1e-4
    # Surface nearer than this to a measured point is there, metres.
    measured: float = 0.004
    # Surface that lies deeper than this in a hand that holds the object for as many frames is not there,
    # metres: hands that were drawn to the surface are off by less.
    inside: float = 0.004


# The stages that look at the clip's pictures at a size of their own.
PictureStage = OptimizeStage | ScaleSearchStage | GraspStage | GraspDepthStage | MoveStage | RefineStage
Stage = PictureStage | ObjectMotionStage | SplitStage | CompletionStage | GuidanceStage


@dataclass(frozen=True)
class RunConfig:
    """Everything that determines the result of a run, except the clip and the hand model."""

    seed: int = 0
    initial: InitialConfig = field(default_factory=InitialConfig)
    hand: HandSplatsConfig = field(default_factory=HandSplatsConfig)
    object: ObjectSplatsConfig = field(default_factory=ObjectSplatsConfig)
    raster: RasterSettings = field(default_factory=RasterSettings)
    # Colours depend on the direction that a surface faces (see `models.lighting`); the paper's are fixed.
    lighting: bool = True
    # Eq. 8's distance of centres, or the distance of surfaces where the image shows touch.
    contact: Literal["center", "surface"] = "surface"
    prior: PriorConfig = field(default_factory=PriorConfig)
    # Open the object's mesh where hands or points are seen through it; None leaves it closed.
    openings: OpeningConfig | None = field(default_factory=OpeningConfig)
    # Files with VGG-16 (and LPIPS's channel weights) for the term "perceptual"; without them it is off.
    perceptual_weights: tuple[str, ...] = ()
    stages: tuple[Stage, ...] = ()
    # Steps between checkpoints within a stage; the end of a stage is always saved.
    checkpoint_every: int = 100

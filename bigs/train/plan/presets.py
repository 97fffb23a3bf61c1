"""Presets: configurations as values. `fast` and `full` go beyond the paper, `paper` is the paper's plan."""

from __future__ import annotations

from dataclasses import replace

from bigs.fields.triplane import TriplaneConfig
from bigs.train.plan.config import (
    CompletionStage,
    GraspDepthStage,
    GraspStage,
    GuidanceStage,
    MoveStage,
    ObjectMotionStage,
    OptimizeStage,
    PriorConfig,
    RefineStage,
    RunConfig,
    ScaleSearchStage,
    SplitStage,
)
from bigs.train.plan.paper import PAPER
from bigs.train.plan.start_config import InitialConfig

# What keeps hand poses plausible while silhouettes move them. Angles in radians, joints in centimetres.
_FINGER_PRIORS = {"pose_prior": 1.0, "fingers_even": 0.3, "joint_axes": 12.0, "finger_tendons": 0.6}
_POSE_PRIORS = {"betas_prior": 0.01, **_FINGER_PRIORS, "orient_prior": 0.1, "acceleration": 0.005}
# Grasps average over frames, so their estimates count more. The four priors on fingers keep their ratios:
# those in which a regressor's errors (12 degrees), the unevenness of fingers, turns about axes that a joint
# does not have (4 degrees, since a model's axes are not exactly a hand's), and bends that tendons do not make
# (8 degrees) usually are.
_GRASP_PRIORS = {
    **_POSE_PRIORS,
    "pose_prior": 5.0,
    "fingers_even": 1.5,
    "joint_axes": 60.0,
    "finger_tendons": 3.0,
}

# Hands that touch the object lie on its surface, and so do the fingers of a grasp; nothing lies inside.
_TOUCH = {"contact": 0.1, "finger_contact": 0.1, "penetration": 0.01}

# Of stages that look at the whole clip in every step.
_SETTLED = 10
_HANDS_COARSE = OptimizeStage(
    name="hands-coarse",
    step="single-subject",
    steps=45,
    lrs={
        "hand.orient": 0.02,
        "hand.pose": 0.02,
        "hand.pose_bias": 0.02,
        "hand.ray": 0.006,
        "hand.depth": 0.01,
        "hand.betas": 0.03,
    },
    weights={"silhouette": 1.0, **_POSE_PRIORS},
    image_size=60,
    final_lr=0.5,
    stop_patience=_SETTLED,
)
_HANDS_FINE = OptimizeStage(
    name="hands-fine",
    step="single-subject",
    steps=75,
    lrs={
        "hand.orient": 0.006,
        "hand.pose": 0.008,
        "hand.pose_bias": 0.008,
        "hand.ray": 0.002,
        "hand.depth": 0.003,
        "hand.betas": 0.015,
    },
    weights={"silhouette": 1.0, **_POSE_PRIORS, "rigid": 0.03},
    image_size=160,
    stop_patience=_SETTLED,
)
# Grasps are known: what all frames of one agree on moves together. A grasp seen from several sides also tells
# how large the hand is beside the object, so that the object's size is learned along with it.
_GRASPED_RATES = {
    "hand.orient": 0.006,
    "hand.pose": 0.008,
    "hand.pose_bias": 0.008,
    "hand.ray": 0.002,
    "hand.depth": 0.003,
    "hand.betas": 0.01,
    "hand.grasp_orient": 0.006,
    "hand.grasp_pose": 0.008,
    "hand.grasp_position": 0.001,
    "object.scale": 0.003,
}
_GRASPED = OptimizeStage(
    name="grasped",
    step="single-subject",
    steps=38,
    lrs=_GRASPED_RATES,
    weights={"silhouette": 1.0, **_GRASP_PRIORS},
    image_size=160,
    final_lr=0.3,
    stop_patience=_SETTLED,
)
_CONTACT = OptimizeStage(
    name="contact",
    step="interacting-subjects",
    steps=38,
    lrs=_GRASPED_RATES,
    weights={"silhouette": 1.0, **_GRASP_PRIORS, **_TOUCH},
    image_size=160,
    stop_patience=_SETTLED,
)
# What steps from a frame's own start cannot mend.
_MOVES = MoveStage(
    name="moves",
    lrs={"hand.orient": 0.02, "hand.pose": 0.03, "hand.ray": 0.004, "hand.depth": 0.006},
    weights={**_FINGER_PRIORS, "acceleration": 0.002, "depth_prior": 1.0},
)
# Between grasps nothing carries a hand, and a few frames decide: many steps for them alone. Their depth is
# read off the size of outlines.
_REGRASP = OptimizeStage(
    name="regrasp",
    step="single-subject",
    steps=70,
    lrs={"hand.orient": 0.015, "hand.pose": 0.03, "hand.ray": 0.003, "hand.depth": 0.008},
    weights={"silhouette": 1.0, **_POSE_PRIORS, "acceleration": 0.002, "depth_prior": 1.0},
    image_size=160,
    free_frames=True,
    stop_patience=_SETTLED,
)

_LIGHT_RATES = {"scene.light": 1e-2, "scene.shade": 1e-2, "scene.ambient": 1e-2}
_LOOKS = {"image": 1.0, "coverage": 0.2, "shade_prior": 0.02}
# What keeps Gaussians near their place, size and colour where pictures say little.
_SHAPE_PRIORS = {"scale": 100.0, "offset": 0.02, "color_prior": 0.05, "thickness": 0.5}
# Every Gaussian has parameters of its own before colours are learned (`SplitStage`): start values have the
# pictures' colours, from which fields lead to no better place, in steps that take nearly twice the time.
# Images are too coarse for finer Gaussians of the object; `RefineStage` splits them later.
_FREED = SplitStage(parts=1)
# The hand's shape is the template's: colours of so few steps say nothing better about it. The object's shape
# is learned from here on, since poor masks leave it a wrong start.
_APPEARANCE = OptimizeStage(
    name="appearance",
    step="single-subject",
    steps=40,
    lrs={
        "hand.color": 0.05,
        "object.color": 0.05,
        "object.shift": 1e-4,
        "object.size": 0.005,
        "object.opacity": 0.01,
        **_LIGHT_RATES,
    },
    weights={**_LOOKS, **_SHAPE_PRIORS},
    image_size=240,
    frames_per_step=6,
)
# The same with the paper's fields, for plans that free Gaussians after it. Fields darken skin that a sleeve
# hides; over a thousand later steps it grows below the sleeve, and bright skin would show as rays.
_FIELDS = replace(
    _APPEARANCE,
    lrs={
        "hand.triplane": 1e-2,
        "hand.appearance": 2e-3,
        "hand.color": 1e-2,
        "object.triplane": 1e-2,
        "object.appearance": 2e-3,
        "object.geometry": 5e-4,
        **_LIGHT_RATES,
    },
    weights={**_LOOKS, "scale": 100.0},
)

# What keeps poses, shape and appearance plausible while everything moves together.
_PLAUSIBLE_TOGETHER = {
    **_SHAPE_PRIORS,
    "shade_prior": 0.01,
    **_POSE_PRIORS,
    # Colours now say what these priors had to say before.
    "pose_prior": 0.2,
    "fingers_even": 0.06,
    "joint_axes": 2.4,
    "finger_tendons": 0.12,
    "depth_prior": 4.0,
    "rigid": 0.03,
    **_TOUCH,
    "object_acceleration": 0.005,
    "object_prior": 0.1,
}
# Everything together: occlusion order, colours and silhouettes agree on poses and appearance at once.
_JOINT = OptimizeStage(
    name="joint",
    step="interacting-subjects",
    steps=150,
    lrs={
        "hand.orient": 0.005,
        "hand.pose": 0.01,
        "hand.ray": 0.0015,
        "hand.depth": 0.0015,
        "hand.grasp_orient": 0.003,
        "hand.grasp_pose": 0.006,
        "hand.grasp_position": 0.0005,
        "object.scale": 0.001,
        "hand.color": 0.03,
        "hand.shift": 5e-5,
        "hand.size": 0.005,
        "hand.opacity": 0.01,
        "object.color": 0.05,
        "object.shift": 1e-4,
        "object.size": 0.005,
        "object.opacity": 0.01,
        "object.orient": 0.002,
        "object.ray": 0.0005,
        "scene.light": 2e-3,
        "scene.shade": 1e-2,
        "scene.ambient": 1e-2,
    },
    weights={
        "image": 4.0,
        "mse": 30.0,
        "alpha_outside": 4.0,
        "labels": 4.0,
        "silhouette": 4.0,
        **_PLAUSIBLE_TOGETHER,
    },
    image_size=240,
    frames_per_step=6,
    frame_moments=True,
)

# The same at nearly the images' own size, where poses are nearly right and print on a label can be seen.
# Without the hands' silhouettes and without labels: who hides whom is settled by then, and a rendering with
# three channels takes less time than one with six.
_DETAIL = OptimizeStage(
    name="detail",
    step="interacting-subjects",
    steps=120,
    lrs={
        "hand.orient": 0.002,
        "hand.pose": 0.004,
        "hand.ray": 0.0005,
        "hand.depth": 0.0005,
        "hand.grasp_orient": 0.001,
        "hand.grasp_pose": 0.002,
        "hand.grasp_position": 0.0002,
        # What is near enough to its place may now take its own shape and look quickly.
        "hand.color": 0.06,
        "hand.shift": 4e-4,
        "hand.size": 0.15,
        "hand.opacity": 0.15,
        "object.color": 0.1,
        "object.shift": 2e-4,
        "object.size": 0.15,
        "object.opacity": 0.15,
        "object.orient": 0.0007,
        "object.ray": 0.0002,
        "scene.light": 2e-3,
        "scene.shade": 1e-2,
        "scene.ambient": 1e-2,
    },
    weights={
        "image": 4.0,
        "mse": 300.0,
        "alpha_outside": 25.0,
        **_PLAUSIBLE_TOGETHER,
    },
    image_size=480,
    frames_per_step=8,
    frame_moments=True,
)

FAST = RunConfig(
    prior=PriorConfig("symmetry"),
    stages=(
        ObjectMotionStage(),
        _HANDS_COARSE,
        _HANDS_FINE,
        ScaleSearchStage(),
        GraspStage(),
        _GRASPED,
        GraspDepthStage(),
        GraspStage(name="grasps-2"),
        _CONTACT,
        _MOVES,
        _REGRASP,
        _FREED,
        _APPEARANCE,
        _JOINT,
        RefineStage(),
        _DETAIL,
        CompletionStage(),
        GuidanceStage(),
    ),
)

# For a little clip, in well under a minute on two cores.
DEMO = replace(
    FAST,
    stages=(
        _HANDS_COARSE,
        replace(_HANDS_FINE, steps=45),
        ScaleSearchStage(),
        GraspStage(),
        replace(_GRASPED, steps=30),
        GraspDepthStage(),
        GraspStage(name="grasps-2"),
        replace(_CONTACT, steps=30),
        _MOVES,
        replace(_REGRASP, steps=45),
        SplitStage(),
        replace(_APPEARANCE, steps=25),
        replace(_JOINT, steps=90),
        CompletionStage(),
        GuidanceStage(steps=150),
    ),
)

# Finer images and fields, and more steps where colours decide. Silhouettes alone get a third more steps than
# in `fast`: many more bend hidden fingers and change the hands' size to fit what masks do not tell. In the
# many steps of `detail` fingers move slowly for the same reason, and the object keeps to what tracks said:
# colours, which light and shade never explain altogether, would in time turn it by some tenths of a degree.
_FIRM_OBJECT = {"object_prior": 50.0}
# So many steps would also turn knuckles that the camera hardly sees into sparks.
_CALM_HANDS = {"hand_color_prior": 0.015, "hand_thickness": 0.15}
FULL = replace(
    FAST,
    hand=replace(FAST.hand, triplane=TriplaneConfig(features=24, resolution=192)),
    object=replace(FAST.object, n_gaussians=12_000, triplane=TriplaneConfig(features=24, resolution=192)),
    stages=(
        ObjectMotionStage(),
        replace(_HANDS_COARSE, steps=60),
        replace(_HANDS_FINE, steps=100),
        ScaleSearchStage(),
        GraspStage(),
        replace(_GRASPED, steps=50),
        replace(_FIELDS, steps=80),
        GraspDepthStage(),
        GraspStage(name="grasps-2"),
        replace(_CONTACT, steps=50),
        _MOVES,
        # Every step brings outlines nearer, and poses with them, long after the loss looks settled.
        replace(_REGRASP, steps=160, stop_patience=0),
        _FREED,
        replace(_JOINT, steps=300, weights=_JOINT.weights | _FIRM_OBJECT | _CALM_HANDS),
        RefineStage(image_size=640),
        replace(
            _DETAIL,
            steps=1000,
            image_size=640,
            lrs=_DETAIL.lrs | {"hand.pose": 0.0016, "hand.grasp_pose": 0.0008},
            weights=_DETAIL.weights | _FIRM_OBJECT | _CALM_HANDS,
        ),
        CompletionStage(),
        GuidanceStage(steps=600),
    ),
)

# Seconds, for tests: every kind of stage, hardly any steps.
SMOKE = replace(
    FAST,
    prior=PriorConfig(),
    hand=replace(FAST.hand, subdivisions=0, triplane=TriplaneConfig(features=4, resolution=32)),
    object=replace(FAST.object, n_gaussians=600, triplane=TriplaneConfig(features=4, resolution=32)),
    initial=InitialConfig(surface_resolution=40, surface_smoothing=0.5),
    stages=(
        replace(_HANDS_COARSE, steps=25),
        replace(_HANDS_FINE, steps=10, image_size=80),
        ScaleSearchStage(candidates=15),
        GraspStage(),
        replace(_GRASPED, steps=8, image_size=80),
        GraspDepthStage(candidates=19, image_size=80),
        replace(_FIELDS, steps=10, image_size=80, frames_per_step=3),
        replace(_CONTACT, steps=8, image_size=80),
        replace(_MOVES, trial_steps=(3, 3), image_size=80, rounds=2),
        replace(_REGRASP, steps=8, image_size=80),
        _FREED,
        # Too few steps for frames to get anywhere on their own.
        replace(_JOINT, steps=12, image_size=80, frames_per_step=3, frame_moments=False),
        RefineStage(image_size=120),
        replace(_DETAIL, steps=6, image_size=120, frames_per_step=3),
        CompletionStage(),
        GuidanceStage(steps=4, views=2),
    ),
)

PRESETS: dict[str, RunConfig] = {"smoke": SMOKE, "demo": DEMO, "fast": FAST, "full": FULL, "paper": PAPER}

"""Presets: ready configurations as values. `fast` and `full` go beyond the paper, `paper` is the paper's plan."""

from __future__ import annotations

from dataclasses import replace

from bigs.train.config import OptimizeStage, RunConfig, ScaleSearchStage

# What keeps hand poses plausible while silhouettes move them. Angles in radians, joints in centimetres.
_POSE_PRIORS = {"betas_prior": 0.01, "pose_prior": 1.0, "orient_prior": 0.1, "acceleration": 0.005}

_HANDS_COARSE = OptimizeStage(
    name="hands-coarse",
    step="single-subject",
    steps=60,
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
)
_HANDS_FINE = replace(
    _HANDS_COARSE,
    name="hands-fine",
    steps=100,
    lrs={
        "hand.orient": 0.006,
        "hand.pose": 0.008,
        "hand.pose_bias": 0.008,
        "hand.ray": 0.002,
        "hand.depth": 0.003,
        "hand.betas": 0.015,
    },
    weights={"silhouette": 1.0, **_POSE_PRIORS, "rigid": 0.03},
    image_size=120,
    final_lr=0.1,
)
_CONTACT = replace(
    _HANDS_FINE,
    name="contact",
    step="interacting-subjects",
    steps=60,
    weights={**_HANDS_FINE.weights, "contact": 0.1, "penetration": 0.01},
)
_APPEARANCE = OptimizeStage(
    name="appearance",
    step="single-subject",
    steps=100,
    lrs={
        "hand.triplane": 1e-2,
        "hand.appearance": 2e-3,
        "hand.skinning": 1e-4,
        "hand.color": 1e-2,
        "object.triplane": 1e-2,
        "object.appearance": 2e-3,
        "object.geometry": 5e-4,
        "scene.light": 1e-2,
        "scene.shade": 1e-2,
    },
    weights={"image": 1.0, "ssim": 0.2, "coverage": 0.2, "shade_prior": 0.02, "scale": 100.0, "lbs": 1000.0},
    image_size=240,
    frames_per_step=6,
)

_JOINT = OptimizeStage(
    name="joint",
    step="interacting-subjects",
    steps=100,
    lrs={
        "hand.orient": 0.002,
        "hand.pose": 0.002,
        "hand.ray": 0.0005,
        "hand.depth": 0.001,
        "hand.triplane": 5e-3,
        "hand.appearance": 1e-3,
        "hand.color": 2e-3,
        "object.triplane": 5e-3,
        "object.appearance": 1e-3,
        "object.geometry": 5e-4,
        "object.orient": 0.002,
        "object.ray": 0.0005,
        "scene.light": 5e-3,
        "scene.shade": 5e-3,
    },
    weights={
        "image": 1.0,
        "ssim": 0.2,
        "mask": 0.5,
        "shade_prior": 0.02,
        "labels": 0.5,
        "silhouette": 0.5,
        "scale": 100.0,
        **_POSE_PRIORS,
        "rigid": 0.03,
        "contact": 0.1,
        "penetration": 0.01,
        "object_acceleration": 0.005,
        "object_prior": 0.1,
    },
    image_size=240,
    frames_per_step=6,
)

FAST = RunConfig(stages=(_HANDS_COARSE, _HANDS_FINE, _APPEARANCE, ScaleSearchStage(), _CONTACT, _JOINT))

PRESETS: dict[str, RunConfig] = {"fast": FAST}

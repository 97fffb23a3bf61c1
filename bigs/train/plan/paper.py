"""The paper's plan as a configuration."""

from __future__ import annotations

from bigs.fields.triplane import TriplaneConfig
from bigs.models.hand_splats import HandSplatsConfig
from bigs.models.object_splats import ObjectSplatsConfig
from bigs.train.plan.config import OptimizeStage, RunConfig
from bigs.train.plan.densify_config import DensifyConfig
from bigs.train.plan.start_config import InitialConfig

# The paper as written: Eq. 4-6 alone for each subject, then Eq. 9 with Eq. 8, one frame a step at full size,
# the released code's rates and steps. No smoothing, no lighting, no search, no surface contact. L_vgg counts
# when its network is given, and so does L_SDS (Eq. 7) with its prior's weights, for the object alone.
_PAPER_IMAGE = {"image": 1.0, "ssim": 0.2, "perceptual": 1.0, "color": 0.1, "scale": 100.0, "mask": 10.0}
# torch's own, with which the released code trains.
_RELEASED_BETAS = (0.9, 0.999)
# The released offsets have no cap; a metre is one that never binds.
_NO_CAP = 1.0
PAPER = RunConfig(
    initial=InitialConfig(smooth_hands=0.0, smooth_object=0.0),
    hand=HandSplatsConfig(triplane=TriplaneConfig(), subdivisions=3, shape_error=0.0, max_offset=_NO_CAP),
    object=ObjectSplatsConfig(triplane=TriplaneConfig(), n_gaussians=10_000, max_offset=_NO_CAP),
    lighting=False,
    contact="center",
    openings=None,
    stages=(
        OptimizeStage(
            name="hands",
            step="single-subject",
            steps=15_000,
            lrs={
                "hand.triplane": 1e-3,
                "hand.appearance": 1e-3,
                "hand.geometry": 1e-3,
                "hand.skinning": 1e-4,
                "hand.orient": 1e-4,
                "hand.pose": 1e-4,
                "hand.ray": 1e-4,
                "hand.depth": 1e-4,
            },
            weights={**_PAPER_IMAGE, "smooth": 1.0, "lbs": 1000.0},
            frames_per_step=1,
            final_lr=1.0,
            adam_betas=_RELEASED_BETAS,
        ),
        OptimizeStage(
            name="object",
            step="single-subject",
            steps=30_000,
            lrs={
                "object.triplane": 1e-3,
                "object.appearance": 1e-3,
                "object.geometry": 1e-3,
                "object.orient": 1e-4,
                "object.ray": 1e-4,
                "object.depth": 1e-4,
            },
            weights={**_PAPER_IMAGE, "sds": 1.0},
            frames_per_step=1,
            final_lr=1.0,
            adam_betas=_RELEASED_BETAS,
            densify=DensifyConfig(),
        ),
        OptimizeStage(
            name="translations",
            step="interacting-subjects",
            steps=30_000,
            lrs={"hand.ray": 2e-3, "hand.depth": 2e-3},
            weights={"image": 1.0, "ssim": 0.2, "perceptual": 1.0, "mask": 10.0, "contact": 1.0},
            frames_per_step=1,
            final_lr=0.01,
            decay="exponential",
            adam_betas=_RELEASED_BETAS,
        ),
    ),
)

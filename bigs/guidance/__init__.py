"""A diffusion model's opinion of a picture as a gradient (paper Eq. 7)."""

from bigs.guidance.denoiser import Conditions, Denoiser, EdgeDetector, classifier_free
from bigs.guidance.schedule import SdsConfig, timestep_range, timestep_weight
from bigs.guidance.sds import sds_loss

__all__ = [
    "Conditions",
    "Denoiser",
    "EdgeDetector",
    "SdsConfig",
    "classifier_free",
    "sds_loss",
    "timestep_range",
    "timestep_weight",
]

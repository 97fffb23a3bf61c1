"""The loss terms by name. Each asks a `Step` for what it needs; a rendering is made when first asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from bigs.checks import check_choice
from bigs.guidance.cameras import virtual_cameras
from bigs.guidance.denoiser import Conditions
from bigs.guidance.schedule import SdsConfig
from bigs.guidance.sds import sds_loss
from bigs.losses.regularizers import color_spread, lbs_deviation, scale_size, squared_norm
from bigs.losses.weighted import mean_of
from bigs.models.free_gaussians import FreeGaussians
from bigs.train.loop import image_terms, pose_terms
from bigs.train.loop.step import Step
from bigs.train.loop.virtual_views import object_orbit, render_object
from bigs.train.plan.config import OptimizeStage

# The paper draws one virtual camera at a time.
_SDS_VIEWS = 1


def color(step: Step) -> Tensor:
    """The paper's L_color: spread of each subject's canonical colours."""
    return mean_of(color_spread(step.canonical[entity].colors) for entity in step.entities)


def scale(step: Step) -> Tensor:
    """The paper's L_scale: size of each subject's canonical Gaussians."""
    return mean_of(scale_size(step.canonical[entity].scales) for entity in step.entities)


def lbs(step: Step) -> Tensor:
    """The paper's L_lbs: squared departure of skinning weights from the hand model's, a mean over hands."""
    return mean_of(
        lbs_deviation(
            step.canonical[side].weights,
            step.scene.hand_splats[step.scene.canonical_side(side)].base_weights,
        )
        for side in step.sides
    )


def offset(step: Step) -> Tensor:
    """Squared distance, in millimetres, that the field moves the object's Gaussians."""
    return (
        squared_norm(1e3 * step.canonical["object"].offsets)
        if "object" in step.canonical
        else torch.zeros(())
    )


def color_prior(step: Step) -> Tensor:
    """Squared change of the colours of the object's free Gaussians from what their field said, in logits.

    Adam takes steps of one size, however little the pictures say. This holds what they hardly show, and is
    nothing against what they show well.
    """
    return mean_of(squared_norm(free.color) for free in _free_object(step))


def hand_color_prior(step: Step) -> Tensor:
    """The same of the hands' free Gaussians."""
    return mean_of(squared_norm(free.color) for free in _free_hands(step))


def thickness(step: Step) -> Tensor:
    """Squared growth of the object's free Gaussians across the surface, logarithmic.

    On outlines they would grow into spikes, which stand out where the camera sees them from aside.
    """
    return mean_of(_growth_across(free) for free in _free_object(step))


def hand_thickness(step: Step) -> Tensor:
    """The same of the hands' free Gaussians."""
    return mean_of(_growth_across(free) for free in _free_hands(step))


def _growth_across(free: FreeGaussians) -> Tensor:
    return squared_norm(free.size[:, 2:].clamp_min(0.0))


def _free_object(step: Step) -> list[FreeGaussians]:
    return [splats for splats in (step.scene.object_splats,) if isinstance(splats, FreeGaussians)]


def _free_hands(step: Step) -> list[FreeGaussians]:
    return [splats for splats in step.scene.hand_splats.values() if isinstance(splats, FreeGaussians)]


def sds(step: Step) -> Tensor:
    """L_SDS (paper Eq. 7) of the object, from `_SDS_VIEWS` places on a sphere around it.

    Rendered at the size that the prior's encoder takes. The gradient w(t) (eps_hat - eps) dz/dI reaches
    whatever makes the object's Gaussians. The value is for logs, see `sds_loss`.
    """
    canonical = step.canonical.get("object")
    if canonical is None:
        return torch.zeros(())
    denoiser, generator = step.evidence.denoiser, step.generator()
    orbit = object_orbit(canonical.means.detach(), step.posed_clip.object)
    directions = torch.nn.functional.normalize(torch.randn(_SDS_VIEWS, 3, generator=generator), dim=-1)
    cameras = virtual_cameras(orbit, directions, denoiser.image_size)
    return sds_loss(
        denoiser,
        render_object(canonical, cameras, denoiser.image_size, step.evidence.settings),
        Conditions(cameras.azimuths, cameras.elevations),
        SdsConfig(),
        progress=step.selection.progress,
        generator=generator,
    )


@dataclass(frozen=True)
class Term:
    """A loss term and what it needs of a step."""

    loss: Callable[[Step], Tensor]  # a scalar
    canonical: bool  # whether it looks at the subjects' Gaussians, which cost an evaluation of their fields

    def __call__(self, step: Step) -> Tensor:
        return self.loss(step)


def _of_gaussians(**losses: Callable[[Step], Tensor]) -> dict[str, Term]:
    return {name: Term(loss, canonical=True) for name, loss in losses.items()}


def _of_poses(**losses: Callable[[Step], Tensor]) -> dict[str, Term]:
    return {name: Term(loss, canonical=False) for name, loss in losses.items()}


# Terms of rendered images, which differ between the paper's two steps.
IMAGE_TERMS: dict[str, dict[str, Term]] = {
    "single-subject": _of_gaussians(
        image=image_terms.image_alone,
        mse=image_terms.mse_alone,
        ssim=image_terms.ssim_alone,
        perceptual=image_terms.perceptual_alone,
        mask=image_terms.mask_alone,
        mask_random=image_terms.mask_random_alone,
        coverage=image_terms.coverage_alone,
    ),
    "interacting-subjects": _of_gaussians(
        image=image_terms.image_together,
        mse=image_terms.mse_together,
        ssim=image_terms.ssim_together,
        perceptual=image_terms.perceptual_together,
        mask=image_terms.mask_together,
        alpha_outside=image_terms.alpha_outside,
        mask_random=image_terms.mask_random_together,
        labels=image_terms.labels,
    ),
}


# Terms of the canonical subjects and of the poses.
TERMS: dict[str, Term] = {
    **_of_gaussians(
        color=color,
        scale=scale,
        lbs=lbs,
        offset=offset,
        color_prior=color_prior,
        thickness=thickness,
        hand_color_prior=hand_color_prior,
        hand_thickness=hand_thickness,
        sds=sds,
    ),
    **_of_poses(
        silhouette=pose_terms.silhouette,  # by Gaussians of its own
        smooth=pose_terms.smooth,
        acceleration=pose_terms.joint_acceleration,
        object_acceleration=pose_terms.object_acceleration,
        orient_prior=pose_terms.orient_prior,
        pose_prior=pose_terms.pose_prior,
        fingers_even=pose_terms.fingers_even,
        joint_axes=pose_terms.joint_axes,
        finger_tendons=pose_terms.finger_tendons,
        depth_prior=pose_terms.depth_prior,
        betas_prior=pose_terms.betas_prior,
        object_prior=pose_terms.object_prior,
        shade_prior=pose_terms.shade_prior,
        rigid=pose_terms.rigid,
        contact=pose_terms.contact,
        finger_contact=pose_terms.finger_contact,
        penetration=pose_terms.penetrating,
    ),
}


def terms_of(stage: OptimizeStage, where: str) -> dict[str, Term]:
    """The terms that a stage, which messages call `where`, names.

    Raises:
        InputError: it names an unknown one, or one of the other kind of step.
    """
    known = IMAGE_TERMS[stage.step] | TERMS
    for name in stage.weights:
        check_choice(where, name, known, "terms")
    return {name: known[name] for name in stage.weights}

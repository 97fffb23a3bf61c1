"""The loss terms by name. Each asks a `Step` for what it needs; a rendering is made when first asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from bigs.checks import check_choice
from bigs.guidance.cameras import virtual_cameras
from bigs.guidance.denoiser import Conditions
from bigs.guidance.schedule import SdsConfig
from bigs.guidance.sds import sds_loss
from bigs.losses.contact import center_contact, penetration, surface_contact
from bigs.losses.mask import outside_mask, outside_mask_on
from bigs.losses.perceptual import masked_perceptual
from bigs.losses.photometric import masked_ssim
from bigs.losses.regularizers import (
    color_spread,
    finger_unevenness,
    impossible_turn,
    lbs_deviation,
    scale_size,
    squared_norm,
)
from bigs.losses.temporal import acceleration, pose_steps, velocity
from bigs.train.loop.step import Step
from bigs.train.loop.virtual_views import object_orbit, render_object
from bigs.train.plan.config import OptimizeStage
from bigs.types import Side

# The paper draws one virtual camera at a time.
_SDS_VIEWS = 1


def _mean(values: Iterable[Tensor]) -> Tensor:
    values = list(values)
    return torch.stack(values).mean() if values else torch.zeros(())


def image_alone(step: Step) -> Tensor:
    """|I - I*| of the paper (Eq. 5) over the pixels that each subject shows, a mean over subjects."""
    return _mean(step.alone_terms(entity).image for entity in step.entities)


def mse_alone(step: Step) -> Tensor:
    """(I - I*)² over the pixels that each subject shows, a mean over subjects."""
    return _mean(step.alone_terms(entity).mse for entity in step.entities)


def ssim_alone(step: Step) -> Tensor:
    """1 - SSIM of each subject inside its own mask (paper Eq. 5), a mean over subjects."""
    return _mean(
        masked_ssim(step.alone(entity).colors, step.images_alone(entity), step.share_alone(entity))
        for entity in step.entities
    )


def mask_alone(step: Step) -> Tensor:
    """The paper's mask regulariser (1 - m) I (Eq. 5) of each subject alone; m is the union of all masks."""
    return _mean(
        outside_mask(step.alone(entity).colors, step.foreground_alone(entity)) for entity in step.entities
    )


def mask_random_alone(step: Step) -> Tensor:
    """`mask` over a random colour, as in the released code: black Gaussians cannot hide outside m."""
    generator = step.generator()
    return _mean(
        outside_mask_on(
            step.alone(entity).colors,
            step.alone(entity).alphas,
            step.foreground_alone(entity),
            generator,
        )
        for entity in step.entities
    )


def perceptual_alone(step: Step) -> Tensor:
    """VGG-16 or LPIPS distance of patches of each subject (paper Eq. 5), a mean over subjects."""
    generator = step.generator()
    return _mean(
        masked_perceptual(
            step.alone(entity).colors,
            step.images_alone(entity),
            step.share_alone(entity),
            step.evidence.perceptual,
            generator,
        )
        for entity in step.entities
    )


def coverage_alone(step: Step) -> Tensor:
    """Each subject opaque on its own pixels, absent from the background, free where others may hide it."""
    return _mean(step.alone_terms(entity).coverage for entity in step.entities)


def image_together(step: Step) -> Tensor:
    """|I - I*| of the paper (Eq. 9) over the pixels that show any subject."""
    return step.together_terms.image


def mse_together(step: Step) -> Tensor:
    """(I - I*)² over the pixels that show any subject."""
    return step.together_terms.mse


def ssim_together(step: Step) -> Tensor:
    """1 - SSIM inside the union of all masks (paper Eq. 9)."""
    return masked_ssim(step.together.colors[..., :3], step.images, step.foreground)


def mask_together(step: Step) -> Tensor:
    """The paper's mask regulariser (1 - m) I, also where sleeves are; `alpha_outside` leaves those out."""
    return outside_mask(step.together.colors[..., :3], step.foreground)


def alpha_outside(step: Step) -> Tensor:
    """Squared alpha outside all masks, per pixel of the masks, without what something unlabelled covers."""
    return step.together_terms.alpha_outside


def mask_random_together(step: Step) -> Tensor:
    """`mask` over a random colour, as in the released code."""
    rendered = step.together
    return outside_mask_on(rendered.colors[..., :3], rendered.alphas, step.foreground, step.generator())


def perceptual_together(step: Step) -> Tensor:
    """VGG-16 or LPIPS distance of patches inside the union of all masks (paper Eq. 9)."""
    return masked_perceptual(
        step.together.colors[..., :3],
        step.images,
        step.foreground,
        step.evidence.perceptual,
        step.generator(),
    )


def labels(step: Step) -> Tensor:
    """Squared difference of label channels and masks: which subject each pixel shows, occlusion included."""
    return step.together_terms.labels


def silhouette(step: Step) -> Tensor:
    """Every hand alone against its own mask, by a few opaque Gaussians on its vertices."""
    return _mean(step.silhouette(side) for side in step.scene.sides if len(step.frames_of(side)))


def color(step: Step) -> Tensor:
    """The paper's L_color: spread of each subject's canonical colours."""
    return _mean(color_spread(step.canonical[entity].colors) for entity in step.entities)


def scale(step: Step) -> Tensor:
    """The paper's L_scale: size of each subject's canonical Gaussians."""
    return _mean(scale_size(step.canonical[entity].scales) for entity in step.entities)


def lbs(step: Step) -> Tensor:
    """The paper's L_lbs: squared departure of skinning weights from the hand model's, a mean over hands."""
    return _mean(
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


def smooth(step: Step) -> Tensor:
    """The paper's L_smt (Eq. 6): squared steps of fingers and wrist from frame to frame."""

    def one(side: Side) -> Tensor:
        pose = step.posed_clip.canonical_hand(side)
        return pose_steps(pose.hand_pose, pose.wrist)

    return _mean(one(side) for side in step.scene.sides)


def joint_acceleration(step: Step) -> Tensor:
    """Second differences of all joints over time, a mean over hands."""
    return _mean(acceleration(joints) for joints in step.joints.values())


def object_acceleration(step: Step) -> Tensor:
    """Second differences over time of three points at the object's reach along its axes."""
    if not step.has_object:
        return torch.zeros(())
    reach = step.scene.object_surface.verts.abs().amax()
    corners = reach * torch.eye(3)
    return acceleration(step.posed_clip.object_points(corners))


def orient_prior(step: Step) -> Tensor:
    """Squared residuals of global orientation, radians."""
    return _mean(squared_norm(poses.orient) for poses in step.scene.hand_poses.values())


def pose_prior(step: Step) -> Tensor:
    """Squared finger residuals of every frame, those of its grasp included."""
    return _mean(
        squared_norm(poses.pose + poses.pose_bias + step.scene.grasps[side].pose_residuals())
        for side, poses in step.scene.hand_poses.items()
    )


def fingers_even(step: Step) -> Tensor:
    """How unevenly joints bend from the index to the pinky, squared radians, a mean over hands."""
    return _mean(finger_unevenness(step.posed_clip.hand(side).hand_pose) for side in step.scene.sides)


def joint_axes(step: Step) -> Tensor:
    """How far finger joints turn about axes that they do not have, squared radians, a mean over hands."""
    return _mean(
        impossible_turn(step.posed_clip.hand(side).hand_pose, step.evidence.impossible_turns[side])
        for side in step.scene.sides
    )


def depth_prior(step: Step) -> Tensor:
    """Squared relative distance from the depth that a frame outside grasps is expected to have."""

    def one(side: Side) -> Tensor:
        poses = step.scene.hand_poses[side]
        away = step.posed_clip.hand(side).wrist[:, 2].log() - poses.expected_log_depth
        return (poses.has_expected_depth * away.square()).mean()

    return _mean(one(side) for side in step.scene.sides)


def betas_prior(step: Step) -> Tensor:
    """Squared change of shape from the start, in the units of betas."""
    return _mean(
        squared_norm(step.scene.betas[side] - step.scene.base_betas[side]) for side in step.scene.betas
    )


def object_prior(step: Step) -> Tensor:
    """Squared departure of the object's poses from their start, counted by how well each frame is known."""
    return squared_norm(step.scene.object_poses.departures()) if step.has_object else torch.zeros(())


def shade_prior(step: Step) -> Tensor:
    """Squared shade of every frame: what one light for the clip explains is not for shade to explain."""
    lighting = step.scene.lighting
    return _mean([] if lighting is None else (squared_norm(shade) for shade in lighting.shade.values()))


def rigid(step: Step) -> Tensor:
    """A hand that holds the object moves with it: its joints stay where they are in the object's frame."""
    if not step.has_object:
        return torch.zeros(())

    def one(side: Side) -> Tensor:
        touching = step.evidence.touching[side]
        joints = step.posed_clip.in_object_frame(step.joints[side])
        return velocity(joints, touching[1:] * touching[:-1])

    return _mean(one(side) for side in step.scene.sides)


def contact(step: Step) -> Tensor:
    """Eq. 8, or its surface form; a mean over the hands."""
    if not step.has_object:
        return torch.zeros(())
    if step.evidence.contact == "center":
        centers = step.posed_clip.object.centers
        return _mean(
            center_contact(centers, joints[:, 0], step.evidence.touching[side])
            for side, joints in step.joints.items()
        )
    return _mean(
        surface_contact(touch.depths, step.evidence.touching[side]) for side, touch in step.touches.items()
    )


def penetrating(step: Step) -> Tensor:
    """Squared depth of hand vertices inside the object, in centimetres beyond a millimetre."""
    if not step.has_object:
        return torch.zeros(())
    return _mean(penetration(touch.sunk) for touch in step.touches.values())


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
        image=image_alone,
        mse=mse_alone,
        ssim=ssim_alone,
        perceptual=perceptual_alone,
        mask=mask_alone,
        mask_random=mask_random_alone,
        coverage=coverage_alone,
    ),
    "interacting-subjects": _of_gaussians(
        image=image_together,
        mse=mse_together,
        ssim=ssim_together,
        perceptual=perceptual_together,
        mask=mask_together,
        alpha_outside=alpha_outside,
        mask_random=mask_random_together,
        labels=labels,
    ),
}

# Terms of the canonical subjects and of the poses.
TERMS: dict[str, Term] = {
    **_of_gaussians(color=color, scale=scale, lbs=lbs, offset=offset, sds=sds),
    **_of_poses(
        silhouette=silhouette,  # by Gaussians of its own
        smooth=smooth,
        acceleration=joint_acceleration,
        object_acceleration=object_acceleration,
        orient_prior=orient_prior,
        pose_prior=pose_prior,
        fingers_even=fingers_even,
        joint_axes=joint_axes,
        depth_prior=depth_prior,
        betas_prior=betas_prior,
        object_prior=object_prior,
        shade_prior=shade_prior,
        rigid=rigid,
        contact=contact,
        penetration=penetrating,
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

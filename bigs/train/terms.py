"""The loss terms by name. Each asks a `Step` for what it needs; a rendering is made when first asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from bigs.losses.contact import center_contact, penetration, surface_contact
from bigs.losses.mask import amodal_silhouette, label_difference, outside_mask, outside_mask_on
from bigs.losses.perceptual import VggWeights, masked_perceptual
from bigs.losses.photometric import masked_l1, masked_mse, masked_ssim
from bigs.losses.regularizers import color_spread, lbs_deviation, scale_size, squared_norm
from bigs.losses.temporal import acceleration, pose_steps, velocity
from bigs.models.hand_splats import CanonicalHand, pose_hand
from bigs.models.object_splats import CanonicalObject
from bigs.models.scene import Scene, concatenate
from bigs.raster import rasterization
from bigs.raster.settings import RasterSettings
from bigs.train.targets import Targets
from bigs.types import Entity, Gaussians, RenderOutput, Side


@dataclass(frozen=True)
class Evidence:
    """What a stage's terms look at besides the scene; fixed for the stage."""

    targets: Targets
    touching: dict[Side, Tensor]  # [T] 1 where the masks of hand and object meet
    silhouettes: dict[Side, CanonicalHand]  # cheap opaque hands, of this resolution
    contact: str  # "center" or "surface"
    settings: RasterSettings
    perceptual: VggWeights | None = None  # what the term "perceptual" needs


@dataclass
class Step:
    """One optimisation step over some frames: holds the canonical Gaussians and what was made from them."""

    scene: Scene
    evidence: Evidence
    entities: tuple[Entity, ...]  # rendered alone or together in this stage
    canonical: dict[Entity, CanonicalHand | CanonicalObject]
    frames: Tensor  # [B]
    with_labels: bool = True  # whether the joint rendering has label channels
    seed: int = 0  # of what the terms draw
    _alone: dict[Entity, RenderOutput] = field(default_factory=dict)

    @property
    def sides(self) -> tuple[Side, ...]:
        return tuple(e for e in self.entities if e != "object")

    @cached_property
    def everything(self) -> Tensor:
        """All frames of the clip, for terms over time."""
        return torch.arange(self.scene.n_frames)

    @cached_property
    def images(self) -> Tensor:
        return self.evidence.targets.images[self.frames]

    @cached_property
    def foreground(self) -> Tensor:
        return self.evidence.targets.foreground[self.frames]

    def share(self, entity: Entity) -> Tensor:
        return self.evidence.targets.shares[entity][self.frames]

    def generator(self) -> torch.Generator:
        """A fresh one for each term, so that what one term draws does not depend on the others."""
        return torch.Generator().manual_seed(self.seed)

    def render(self, gaussians: Gaussians) -> RenderOutput:
        """Render B frames on black: colours [B, H, W, D], alphas [B, H, W, 1]."""
        targets = self.evidence.targets
        out = rasterization(
            *gaussians,
            torch.eye(4)[None],
            targets.K[None],
            targets.width,
            targets.height,
            settings=self.evidence.settings,
        )
        return RenderOutput(out.colors[:, 0], out.alphas[:, 0], out.info)

    def alone(self, entity: Entity) -> RenderOutput:
        """One subject rendered without the others (the paper's single-subject step)."""
        if entity not in self._alone:
            self._alone[entity] = self.render(self.scene.posed(entity, self.canonical[entity], self.frames))
        return self._alone[entity]

    @cached_property
    def together(self) -> RenderOutput:
        """All subjects in one pass; after the three colours, one label channel per entity if labels count."""
        labels = torch.eye(len(self.entities))
        parts = []
        for entity, label in zip(self.entities, labels, strict=True):
            part = self.scene.posed(entity, self.canonical[entity], self.frames)
            if self.with_labels:
                channels = torch.cat([part.colors, label.expand(*part.colors.shape[:-1], -1)], dim=-1)
                part = part._replace(colors=channels)
            parts.append(part)
        return self.render(concatenate(parts))

    @cached_property
    def hands(self) -> dict[Side, tuple[Tensor, Tensor]]:
        """Vertices and joints of every hand in every frame of the clip."""
        return {side: self.scene.hand_points(side, self.everything) for side in self.scene.sides}

    @cached_property
    def object_distances(self) -> dict[Side, Tensor]:
        """Signed distance [T, V] in metres of each hand's vertices from the object's surface."""
        scale = self.scene.object_poses.log_scale.exp()
        return {
            side: scale * self.scene.object_distance(self.scene.in_object_frame(verts, self.everything))
            for side, (verts, _) in self.hands.items()
        }

    @property
    def has_object(self) -> bool:
        return self.scene.object_splats is not None


def _mean(values: Iterable[Tensor]) -> Tensor:
    values = list(values)
    return torch.stack(values).mean() if values else torch.zeros(())


def _each_alone(step: Step, loss: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Tensor:
    return _mean(loss(step.alone(entity).colors, step.images, step.share(entity)) for entity in step.entities)


def image_alone(step: Step) -> Tensor:
    return _each_alone(step, masked_l1)


def mse_alone(step: Step) -> Tensor:
    return _each_alone(step, masked_mse)


def ssim_alone(step: Step) -> Tensor:
    return _each_alone(step, masked_ssim)


def mask_alone(step: Step) -> Tensor:
    return _mean(outside_mask(step.alone(entity).colors, step.foreground) for entity in step.entities)


def mask_random_alone(step: Step) -> Tensor:
    generator = step.generator()
    return _mean(
        outside_mask_on(step.alone(entity).colors, step.alone(entity).alphas, step.foreground, generator)
        for entity in step.entities
    )


def perceptual_alone(step: Step) -> Tensor:
    generator = step.generator()
    return _mean(
        masked_perceptual(
            step.alone(entity).colors, step.images, step.share(entity), step.evidence.perceptual, generator
        )
        for entity in step.entities
    )


def coverage_alone(step: Step) -> Tensor:
    """Each subject opaque on its own pixels, absent from the background, free where others may hide it."""
    targets = step.evidence.targets
    return _mean(
        amodal_silhouette(
            step.alone(entity).alphas[..., 0], step.share(entity), targets.hidden(entity)[step.frames]
        )
        for entity in step.entities
    )


def image_together(step: Step) -> Tensor:
    return masked_l1(step.together.colors[..., :3], step.images, step.foreground)


def mse_together(step: Step) -> Tensor:
    return masked_mse(step.together.colors[..., :3], step.images, step.foreground)


def ssim_together(step: Step) -> Tensor:
    return masked_ssim(step.together.colors[..., :3], step.images, step.foreground)


def mask_together(step: Step) -> Tensor:
    return outside_mask(step.together.colors[..., :3], step.foreground)


def mask_random_together(step: Step) -> Tensor:
    rendered = step.together
    return outside_mask_on(rendered.colors[..., :3], rendered.alphas, step.foreground, step.generator())


def perceptual_together(step: Step) -> Tensor:
    return masked_perceptual(
        step.together.colors[..., :3],
        step.images,
        step.foreground,
        step.evidence.perceptual,
        step.generator(),
    )


def labels(step: Step) -> Tensor:
    visible = torch.stack([step.share(entity) for entity in step.entities], dim=-1)
    return label_difference(step.together.colors[..., 3:], visible)


def silhouette(step: Step) -> Tensor:
    """Every hand alone against its own mask, by a few opaque Gaussians on its vertices."""

    def one(side: Side) -> Tensor:
        scene, evidence = step.scene, step.evidence
        posed = pose_hand(
            scene.hand_model(side),
            evidence.silhouettes[side],
            scene.hand_betas(side),
            scene.hand_frames(side, step.frames),
            side,
        )
        hidden = evidence.targets.hidden(side)[step.frames]
        return amodal_silhouette(step.render(posed).alphas[..., 0], step.share(side), hidden)

    return _mean(one(side) for side in step.scene.sides)


def color(step: Step) -> Tensor:
    return _mean(color_spread(step.canonical[entity].colors) for entity in step.entities)


def scale(step: Step) -> Tensor:
    return _mean(scale_size(step.canonical[entity].scales) for entity in step.entities)


def lbs(step: Step) -> Tensor:
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


def smooth(step: Step) -> Tensor:
    """The paper's L_smt over the whole clip."""

    def one(side: Side) -> Tensor:
        pose = step.scene.hand_frames(side, step.everything)
        return pose_steps(torch.cat([pose.global_orient[:, None], pose.hand_pose], dim=1), pose.wrist)

    return _mean(one(side) for side in step.scene.sides)


def joint_acceleration(step: Step) -> Tensor:
    return _mean(acceleration(joints) for _, joints in step.hands.values())


def object_acceleration(step: Step) -> Tensor:
    if not step.has_object:
        return torch.zeros(())
    reach = step.scene.object_surface.verts.abs().amax()
    corners = reach * torch.eye(3)
    return acceleration(step.scene.object_points(corners, step.everything))


def orient_prior(step: Step) -> Tensor:
    return _mean(squared_norm(poses.orient) for poses in step.scene.hand_poses.values())


def pose_prior(step: Step) -> Tensor:
    """Squared finger residuals of every frame, those of its grasp included."""
    return _mean(
        squared_norm(poses.pose + poses.pose_bias + step.scene.grasps[side].pose_residuals())
        for side, poses in step.scene.hand_poses.items()
    )


def betas_prior(step: Step) -> Tensor:
    """Squared change of shape from the start, in the units of betas."""
    return _mean(
        squared_norm(step.scene.betas[side] - step.scene.base_betas[side]) for side in step.scene.betas
    )


def object_prior(step: Step) -> Tensor:
    return squared_norm(step.scene.object_poses.orient) if step.has_object else torch.zeros(())


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
        joints = step.scene.in_object_frame(step.hands[side][1], step.everything)
        return velocity(joints, touching[1:] * touching[:-1])

    return _mean(one(side) for side in step.scene.sides)


def contact(step: Step) -> Tensor:
    """Eq. 8, or its surface form; a mean over the hands."""
    if not step.has_object:
        return torch.zeros(())
    if step.evidence.contact == "center":
        centers = step.scene.object_frames(step.everything).centers
        return _mean(
            center_contact(centers, joints[:, 0], step.evidence.touching[side])
            for side, (_, joints) in step.hands.items()
        )
    return _mean(
        surface_contact(distances, step.evidence.touching[side])
        for side, distances in step.object_distances.items()
    )


def penetrating(step: Step) -> Tensor:
    if not step.has_object:
        return torch.zeros(())
    return _mean(penetration(distances) for distances in step.object_distances.values())


# Terms of rendered images, which differ between the paper's two steps.
IMAGE_TERMS: dict[str, dict[str, Callable[[Step], Tensor]]] = {
    "single-subject": {
        "image": image_alone,
        "mse": mse_alone,
        "ssim": ssim_alone,
        "perceptual": perceptual_alone,
        "mask": mask_alone,
        "mask_random": mask_random_alone,
        "coverage": coverage_alone,
    },
    "interacting-subjects": {
        "image": image_together,
        "mse": mse_together,
        "ssim": ssim_together,
        "perceptual": perceptual_together,
        "mask": mask_together,
        "mask_random": mask_random_together,
        "labels": labels,
    },
}

# Terms of the canonical subjects and of the poses.
TERMS: dict[str, Callable[[Step], Tensor]] = {
    "silhouette": silhouette,
    "color": color,
    "scale": scale,
    "lbs": lbs,
    "offset": offset,
    "smooth": smooth,
    "acceleration": joint_acceleration,
    "object_acceleration": object_acceleration,
    "orient_prior": orient_prior,
    "pose_prior": pose_prior,
    "betas_prior": betas_prior,
    "object_prior": object_prior,
    "shade_prior": shade_prior,
    "rigid": rigid,
    "contact": contact,
    "penetration": penetrating,
}

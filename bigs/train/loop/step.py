"""One optimisation step: what it looks at, and renderings that are made when a term first asks for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from bigs.losses.perceptual import VggWeights
from bigs.models.canonical import CanonicalHand, CanonicalObject
from bigs.models.moments import Moments
from bigs.models.scene import Scene
from bigs.raster import rasterization
from bigs.raster.api import Means2d
from bigs.raster.settings import RasterSettings
from bigs.train.loop.targets import Targets
from bigs.types import Entity, Gaussians, RenderOutput, Side


@dataclass(frozen=True)
class Evidence:
    """The data of a stage's terms besides the scene; fixed for the stage."""

    targets: Targets
    touching: dict[Side, Tensor]  # [T] 1 where a hand touches the object, as far as known
    silhouettes: dict[Side, CanonicalHand]  # cheap opaque hands for this resolution
    contact: str  # "center" or "surface"
    settings: RasterSettings
    perceptual: VggWeights | None = None  # the network of the term "perceptual"


# A pixel counts as covered by an unlabelled occluder above this share.
_COVERED = 0.5


class Pixels(NamedTuple):
    """The M pixels of a joint rendering that count; all others are rightly empty or covered."""

    colors: Tensor  # [M, D] rendered
    alphas: Tensor  # [M, 1] rendered
    images: Tensor  # [M, 3]
    foreground: Tensor  # [M]
    empty: Tensor  # [M] share that shows neither a subject nor an unlabelled occluder
    shares: Tensor  # [M, E] for the entities rendered


@dataclass(frozen=True)
class Selection:
    """What one step looks at: which subjects, in which frames, and how."""

    frames: Tensor  # [B]
    entities: tuple[Entity, ...] = ()  # rendered alone or together; none if no term looks at Gaussians
    labels: bool = True  # whether the joint rendering has label channels
    seed: int = 0  # random seed of the terms
    free_frames: bool = False  # whether a hand alone is rendered where it holds nothing, not at `frames`
    pull: bool = False  # whether `Step.object_pull` will be needed


@dataclass
class Step:
    """One optimisation step over some frames: holds the canonical Gaussians and what was made from them."""

    scene: Scene
    evidence: Evidence
    canonical: dict[Entity, CanonicalHand | CanonicalObject]  # of the selection's entities
    selection: Selection
    _alone: dict[Entity, RenderOutput] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.selection.pull:
            self.canonical["object"].means.retain_grad()

    @property
    def entities(self) -> tuple[Entity, ...]:
        return self.selection.entities

    @property
    def frames(self) -> Tensor:
        return self.selection.frames

    @property
    def sides(self) -> tuple[Side, ...]:
        return tuple(e for e in self.entities if e != "object")

    @cached_property
    def clip(self) -> Moments:
        """All frames, for terms over time."""
        return self.scene.at(torch.arange(self.scene.n_frames))

    def frames_of(self, entity: Entity) -> Tensor:
        """The frames in which a subject is looked at alone."""
        if self.selection.free_frames and entity != "object":
            return self.scene.free_frames(entity)
        return self.frames

    @cached_property
    def images(self) -> Tensor:
        return _at(self.evidence.targets.images, self.frames)

    @cached_property
    def foreground(self) -> Tensor:
        return _at(self.evidence.targets.foreground, self.frames)

    def share(self, entity: Entity) -> Tensor:
        return _at(self.evidence.targets.shares[entity], self.frames)

    def images_alone(self, entity: Entity) -> Tensor:
        """The images in which a subject is looked at alone."""
        return _at(self.evidence.targets.images, self.frames_of(entity))

    def share_alone(self, entity: Entity) -> Tensor:
        """The subject's share of their pixels."""
        return _at(self.evidence.targets.shares[entity], self.frames_of(entity))

    def hidden_alone(self, entity: Entity) -> Tensor:
        """The share of their pixels in which something else may hide it."""
        return _at(self.evidence.targets.hidden[entity], self.frames_of(entity))

    def foreground_alone(self, entity: Entity) -> Tensor:
        """The share of their pixels that shows any subject."""
        return _at(self.evidence.targets.foreground, self.frames_of(entity))

    def generator(self) -> torch.Generator:
        """A fresh one for each term, so that what one term draws does not depend on the others."""
        return torch.Generator().manual_seed(self.selection.seed)

    def render(self, gaussians: Gaussians, means2d: Means2d = "values") -> RenderOutput:
        """Render B frames on black: colours [B, H, W, D], alphas [B, H, W, 1]."""
        targets = self.evidence.targets
        out = rasterization(
            *gaussians,
            torch.eye(4)[None],
            targets.K[None],
            targets.width,
            targets.height,
            settings=self.evidence.settings,
            means2d=means2d,
        )
        # Not [:, 0], whose gradient would be copied into zeros.
        return RenderOutput(out.colors.squeeze(1), out.alphas.squeeze(1), out.info)

    def alone(self, entity: Entity) -> RenderOutput:
        """One subject rendered without the others (the paper's single-subject step)."""
        if entity not in self._alone:
            frames = self.frames_of(entity)
            posed = self.clip.at(frames).posed({entity: self.canonical[entity]})
            if self.selection.pull and entity == "object":
                self._alone[entity] = self.render(posed, "full")
                self._alone[entity].info["means2d"].retain_grad()
            else:
                self._alone[entity] = self.render(posed)
        return self._alone[entity]

    def object_pull(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """How the loss pulls at the object's N Gaussians, after the backward pass of a step with `pull`.

        Returns:
            The gradient [B, N, 2] at their centres on screen, of an error averaged over all pixels of one of
            the clip's images, per half that image; whether each is in view [B, N]; the gradient [N, 3] at
            their centres in the object's frame. None if no term has rendered the object alone.
        """
        if "object" not in self._alone:
            return None
        info = self._alone["object"].info
        # The clip's whole image in pixels of this stage's size.
        zoom = self.evidence.targets.K.diagonal()[:2] / self.scene.K.diagonal()[:2]
        size = zoom * zoom.new_tensor([self.scene.width, self.scene.height])
        # Image terms average over the object's pixels in all views, and over the subjects.
        average = len(self.entities) * self.share_alone("object").sum() / size.prod()
        on_screen = average * 0.5 * size * info["means2d"].grad.squeeze(1)
        return on_screen, info["depths"].squeeze(1) > 0, self.canonical["object"].means.grad

    @cached_property
    def together(self) -> RenderOutput:
        """All subjects in one pass; after the three colours, one label channel per entity if labels count."""
        canonical = {entity: self.canonical[entity] for entity in self.entities}
        return self.render(self.clip.at(self.frames).posed(canonical, self.selection.labels))

    @cached_property
    def pixels(self) -> Pixels:
        """For terms that look at each pixel for itself: hands and object fill a small part of an image.

        What something unlabelled covers is left out: behind a sleeve a hand may be, but does not show.
        """
        rendered, foreground = self.together, self.foreground
        unknown = _at(self.evidence.targets.unknown, self.frames)
        counts = ((foreground > 0.0) | (rendered.alphas.squeeze(-1) > 0.0)) & (unknown <= _COVERED)
        index = torch.nonzero(counts.flatten()).flatten()

        def some(values: Tensor) -> Tensor:
            return values.flatten(0, 2).index_select(0, index)

        shares = torch.stack([self.share(entity).flatten()[index] for entity in self.entities], dim=-1)
        shown = some(foreground)
        return Pixels(
            some(rendered.colors),
            some(rendered.alphas),
            some(self.images),
            shown,
            (1.0 - shown - some(unknown)).clamp_min(0.0),
            shares,
        )

    @cached_property
    def joints(self) -> dict[Side, Tensor]:
        """Joints [T, 21, 3] of every hand in every frame of the clip."""
        return {side: self.clip.joints(side) for side in self.scene.sides}

    @cached_property
    def object_distances(self) -> dict[Side, Tensor]:
        """Signed distance [T, V] in metres of each hand's vertices from the object's surface."""
        scale = self.scene.object_poses.log_scale.exp()
        return {
            side: scale * self.scene.object_distance(self.clip.in_object_frame(self.clip.verts(side)))
            for side in self.scene.sides
        }

    @property
    def has_object(self) -> bool:
        return self.scene.object_splats is not None


def _at(values: Tensor, frames: Tensor) -> Tensor:
    """Values [T, ...] of `frames` [B], which rise: all of them are not worth a copy."""
    return values if len(frames) == len(values) else values[frames]

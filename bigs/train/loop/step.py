"""One optimisation step: what it looks at, and renderings that are made when a term first asks for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from bigs.checks import InputError
from bigs.fused.fingers import FingerCosts, finger_costs
from bigs.fused.outline import covered_shares
from bigs.fused.pixels import AloneTerms, TogetherTerms, alone_terms, together_terms
from bigs.fused.touch import Touch
from bigs.geometry.spread import spread
from bigs.guidance.denoiser import Denoiser
from bigs.losses.perceptual import VggWeights
from bigs.models.canonical import CanonicalHand, CanonicalObject
from bigs.models.posed_scene import PosedScene
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
    impossible_turns: dict[Side, Tensor]  # [M, 15, 3, 3] what finger joints cannot do, of canonical hands
    bends: dict[Side, Tensor]  # [2, 2, 4, 15, 3, 3] how far finger joints bend, of canonical hands
    contact: str  # "center" or "surface"
    settings: RasterSettings
    perceptual: VggWeights | None = None  # the network of the term "perceptual"
    denoiser: Denoiser | None = None  # the diffusion prior of the term "sds"


# A pixel counts as covered by an unlabelled occluder above this share.
_COVERED = 0.5
# Steps that look at a few frames measure touch in every so many of the clip, taking turns: neighbours say
# nearly the same, and all of them would take a tenth of a step.
_TOUCH_EVERY = 3


@dataclass(frozen=True)
class Selection:
    """What one step looks at: which subjects, in which frames, and how."""

    frames: Tensor  # [B]
    entities: tuple[Entity, ...] = ()  # rendered alone or together; none if no term looks at Gaussians
    labels: bool = True  # whether the joint rendering has label channels
    seed: int = 0  # random seed of the terms
    free_frames: bool = False  # whether a hand alone is rendered where it is in no grasp, not at `frames`
    progress: float = 0.0  # share of the stage's steps that is done
    pull: bool = False  # whether `Step.object_pull` will be needed


@dataclass
class Step:
    """One optimisation step over some frames: holds the canonical Gaussians and what was made from them."""

    scene: Scene
    evidence: Evidence
    canonical: dict[Entity, CanonicalHand | CanonicalObject]  # of the selection's entities
    selection: Selection
    # Views and channels of each rendering made so far; what a mesh covers has none.
    pictures: list[tuple[int, int]] = field(default_factory=list)
    _alone: dict[Entity, RenderOutput] = field(default_factory=dict)
    _alone_terms: dict[Entity, AloneTerms] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.selection.pull:
            self.canonical["object"].means.retain_grad()

    @property
    def entities(self) -> tuple[Entity, ...]:
        """The subjects that are rendered."""
        return self.selection.entities

    @property
    def whole_size(self) -> Tensor:
        """Width and height [2] of the clip's whole image in pixels of this stage's size."""
        zoom = self.evidence.targets.K.diagonal()[:2] / self.scene.K.diagonal()[:2]
        return zoom * zoom.new_tensor([self.scene.width, self.scene.height])

    @property
    def frames(self) -> Tensor:
        """Indices [B] of the frames that are looked at."""
        return self.selection.frames

    @property
    def sides(self) -> tuple[Side, ...]:
        """The hands among the subjects that are rendered."""
        return tuple(e for e in self.entities if e != "object")

    @cached_property
    def posed_clip(self) -> PosedScene:
        """All frames, for terms over time."""
        return self.scene.at(torch.arange(self.scene.n_frames))

    def frames_of(self, entity: Entity) -> Tensor:
        """Indices [B] of the frames in which a subject is looked at alone."""
        if self.selection.free_frames and entity != "object":
            return self.scene.free_frames(entity)
        return self.frames

    @cached_property
    def images(self) -> Tensor:
        """The clip's images [B, H, W, 3] in [0, 1]."""
        return _at(self.evidence.targets.images, self.frames)

    @cached_property
    def foreground(self) -> Tensor:
        """The share [B, H, W] of each pixel that shows any subject."""
        return _at(self.evidence.targets.foreground, self.frames)

    def share(self, entity: Entity) -> Tensor:
        """The share [B, H, W] of each pixel that shows a subject."""
        return _at(self.evidence.targets.shares[entity], self.frames)

    def images_alone(self, entity: Entity) -> Tensor:
        """The images [B, H, W, 3] in which a subject is looked at alone."""
        return _at(self.evidence.targets.images, self.frames_of(entity))

    def share_alone(self, entity: Entity) -> Tensor:
        """The subject's share [B, H, W] of their pixels."""
        return _at(self.evidence.targets.shares[entity], self.frames_of(entity))

    def hidden_alone(self, entity: Entity) -> Tensor:
        """The share [B, H, W] of their pixels in which something else may hide it."""
        return _at(self.evidence.targets.hidden[entity], self.frames_of(entity))

    def foreground_alone(self, entity: Entity) -> Tensor:
        """The share [B, H, W] of their pixels that shows any subject."""
        return _at(self.evidence.targets.foreground, self.frames_of(entity))

    def generator(self) -> torch.Generator:
        """A fresh one for each term, so that what one term draws does not depend on the others."""
        return torch.Generator().manual_seed(self.selection.seed)

    def render(self, gaussians: Gaussians, means2d: Means2d = "values") -> RenderOutput:
        """Render B frames on black: colours [B, H, W, D], alphas [B, H, W, 1]."""
        targets = self.evidence.targets
        self.pictures.append((len(gaussians.means), gaussians.colors.shape[-1]))
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
            posed = self.posed_clip.at(frames).posed({entity: self.canonical[entity]})
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
        size = self.whole_size
        # Image terms average over the object's pixels in all views, and over the subjects.
        average = len(self.entities) * self.share_alone("object").sum() / size.prod()
        on_screen = average * 0.5 * size * info["means2d"].grad.squeeze(1)
        return on_screen, info["depths"].squeeze(1) > 0, self.canonical["object"].means.grad

    @cached_property
    def together(self) -> RenderOutput:
        """All subjects in one pass; after the three colours, one label channel per entity if labels count."""
        canonical = {entity: self.canonical[entity] for entity in self.entities}
        return self.render(self.posed_clip.at(self.frames).posed(canonical, self.selection.labels))

    @cached_property
    def together_terms(self) -> TogetherTerms:
        """What each pixel of the joint rendering says.

        What something unlabelled covers is left out: behind a sleeve a hand may be, but does not show.
        """
        targets, rendered = self.evidence.targets, self.together
        shares = [targets.shares[entity] for entity in self.entities] if self.selection.labels else []
        return together_terms(
            rendered.colors,
            rendered.alphas,
            targets.images,
            targets.foreground,
            targets.unknown,
            shares,
            self.frames,
            _COVERED,
        )

    def alone_terms(self, entity: Entity) -> AloneTerms:
        """What each pixel of one subject's own rendering says."""
        if entity not in self._alone_terms:
            rendered = self.alone(entity)
            self._alone_terms[entity] = self._against_own(entity, rendered.colors, rendered.alphas)
        return self._alone_terms[entity]

    def silhouette(self, side: Side) -> Tensor:
        """How far what a hand's mesh covers is from what its own mask allows, a scalar.

        See `losses.mask.amodal_silhouette`.
        """
        verts = self.posed_clip.at(self.frames_of(side)).verts(side)
        return self._against_own(side, None, self.covered(side, verts)[..., None]).coverage

    def covered(self, side: Side, verts: Tensor) -> Tensor:
        """The share [B, H, W] of each pixel that a hand covers whose vertices are at `verts` [B, V, 3]."""
        targets, faces = self.evidence.targets, self.scene.hand_model(side).faces
        self.pictures.append((len(verts), 0))
        try:
            return covered_shares(verts, faces, targets.K, targets.width, targets.height)
        except ValueError as error:
            raise InputError(str(error)) from None

    def _against_own(self, entity: Entity, colors: Tensor | None, alphas: Tensor) -> AloneTerms:
        targets = self.evidence.targets
        own, hidden = targets.shares[entity], targets.hidden[entity]
        return alone_terms(colors, alphas, targets.images, own, hidden, self.frames_of(entity))

    @cached_property
    def joints(self) -> dict[Side, Tensor]:
        """Joints [T, 21, 3] of every hand in every frame of the clip."""
        return {side: self.posed_clip.joints(side) for side in self.scene.sides}

    @cached_property
    def finger_costs(self) -> dict[Side, FingerCosts]:
        """What the fingers of every hand cost, a mean over the clip."""
        return {
            side: finger_costs(
                self.posed_clip.hand(side).hand_pose,
                self.evidence.impossible_turns[side],
                self.evidence.bends[side],
            )
            for side in self.scene.sides
        }

    @cached_property
    def touch_frames(self) -> Tensor:
        """Indices [S] of the frames in which touch is measured, rising."""
        count = self.scene.n_frames
        every = 1 if len(self.frames) == count else min(_TOUCH_EVERY, count)
        return torch.arange(self.selection.seed % every, count, every)

    @cached_property
    def touches(self) -> dict[Side, Touch]:
        """What of each hand touches the object in each of `touch_frames`."""
        posed = self.posed_clip.at(self.touch_frames)
        return {side: posed.touch(side) for side in self.scene.sides}

    @property
    def has_object(self) -> bool:
        """Whether the scene has an object."""
        return self.scene.object_splats is not None


def spread_frames(n_frames: int, most: int) -> Tensor:
    """At most so many frames of a clip, evenly spread."""
    return torch.from_numpy(spread(n_frames, most))


def _at(values: Tensor, frames: Tensor) -> Tensor:
    """Values [T, ...] of `frames` [B], which rise: all of them are not worth a copy."""
    return values if len(frames) == len(values) else values[frames]

"""First guesses of a hand's pose in single frames: many views of a few rest hands, the likely ones kept.

Seen from far away a hand and its reflection in depth look alike, and one frame cannot tell them apart. So
every frame keeps several candidates, and the choice falls on the sequence that moves least (the Viterbi
algorithm).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bigs.geometry.rotations import quat_to_matrix
from bigs.preprocess.hands.skeleton import HandPoses, HandSkeleton

# Bends of the fingers to try, as shares of their range towards the palm.
_BENDS = (0.05, 0.3, 0.55, 0.8)
_VIEWS = 96
# Candidates of a frame differ by at least this angle or this bend of the fingers, radians.
_APART = 0.45


def guess_poses(skeleton: HandSkeleton, rays: Tensor, trust: Tensor, count: int) -> HandPoses:
    """Match keypoints with rest hands seen from all sides under weak perspective.

    For every view the best turn in the image, size and place have a closed form; joints that the best view
    cannot explain are trusted less and the views compared once more.

    Args:
        skeleton: of the right hand.
        rays: [B, 21, 2] keypoints as x / z, y / z.
        trust: [B, 21], 0 for a joint that was not seen; every frame has some.
        count: candidates to keep of each frame.

    Returns:
        Poses with leading axes [B, count], the likeliest first.
    """
    bent = skeleton.mean.repeat(len(_BENDS), 1, 1)
    bent[:, :, 0] = torch.tensor(_BENDS)[:, None] * skeleton.highest[:, 0]
    bent[:, 12:, 0] *= 0.5
    identity = torch.eye(3).expand(len(bent), 3, 3)
    shapes = skeleton.joints(torch.zeros(10), bent, identity, torch.zeros(len(bent), 3))
    views = _views(_VIEWS)
    seen = torch.einsum("vij,snj->svni", views, shapes)  # [S, V, 21, 3]
    model = torch.complex(seen[..., 0], seen[..., 1]).flatten(0, 1)  # [S V, 21]
    found = torch.complex(rays[..., 0], rays[..., 1])

    turn, place, misfit = _similarities(model, found, trust)
    best = misfit.argmin(dim=1)
    rows = torch.arange(len(rays))
    explained = turn[rows, best][:, None] * model[best] + place[rows, best][:, None]
    error = (explained - found).abs()
    typical = error.masked_fill(trust <= 0, math.nan).nanmedian(dim=1, keepdim=True).values
    trust = trust / (1.0 + (error / (2.0 * typical).clamp_min(1e-6)).square()).square()
    turn, place, misfit = _similarities(model, found, trust)

    chosen = _distinct(misfit, views, len(bent), count)
    pick = lambda values: values.gather(1, chosen)  # noqa: E731
    a, b = pick(turn), pick(place)
    depth = 1.0 / a.abs().clamp_min(1e-6)
    spin = _about_z(a.angle())
    orient = spin @ views[chosen % _VIEWS]
    # b is the image of the model's origin; the wrist lies beside it.
    anchor = torch.einsum("bkij,bkj->bki", orient, shapes[chosen // _VIEWS][:, :, 0])
    wrist = torch.stack([b.real * depth, b.imag * depth, depth], dim=-1) + anchor
    return HandPoses(bent[chosen // _VIEWS], orient, wrist)


def likeliest_sequence(joints: Tensor, energy: Tensor, times: Tensor, reach: float) -> Tensor:
    """Which candidate to take in each frame so that the hand moves least.

    Args:
        joints: [T, K, 21, 3] of the candidates, metres; only the motion about the wrist counts.
        energy: [T, K] how badly each explains its frame.
        times: [T] frame numbers, increasing; a longer pause allows more motion.
        reach: joints move by about this much from frame to frame, metres.

    Returns:
        [T] indices.
    """
    shape = joints - joints[:, :, :1]
    total = energy[0]
    came_from = []
    for t in range(1, len(joints)):
        step = (shape[t - 1][:, None] - shape[t][None]).square().sum(-1).mean(-1)
        steps = step / (reach * float(times[t] - times[t - 1])) ** 2
        # The joints of a hand move together, so a step counts like that of about two points. It is bounded,
        # because a wrong frame should cost no more than being wrong.
        cost = 3.0 * steps / (1.0 + steps / 10.0)
        both = total[:, None] + cost
        total, source = both.min(dim=0)
        total = total + energy[t]
        came_from.append(source)
    path = [int(total.argmin())]
    for source in reversed(came_from):
        path.append(int(source[path[-1]]))
    return torch.tensor(path[::-1])


def _views(count: int) -> Tensor:
    """Rotations [V, 3, 3] that turn `count` directions, spread evenly over the sphere, to the camera."""
    index = torch.arange(count) + 0.5
    polar = torch.acos(1.0 - 2.0 * index / count)
    around = math.pi * (1.0 + math.sqrt(5.0)) * index
    zeros = torch.zeros_like(polar)
    half, third = polar / 2, around / 2
    about_x = torch.stack([half.cos(), half.sin(), zeros, zeros], dim=-1)
    about_z = torch.stack([third.cos(), zeros, zeros, third.sin()], dim=-1)
    return quat_to_matrix(about_x) @ quat_to_matrix(about_z)


def _about_z(angle: Tensor) -> Tensor:
    zeros = torch.zeros_like(angle)
    return quat_to_matrix(torch.stack([(angle / 2).cos(), zeros, zeros, (angle / 2).sin()], dim=-1))


def _similarities(model: Tensor, found: Tensor, trust: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The plane similarity `found = turn * model + place` for every pair, weighted least squares.

    Args:
        model: [M, 21] complex.
        found: [B, 21] complex.
        trust: [B, 21].

    Returns:
        turn and place [B, M] complex, and the root mean square misfit [B, M].
    """
    weight = trust / trust.sum(dim=1, keepdim=True)
    complex_weight = weight.to(model.dtype)
    middle = (weight * found).sum(1, keepdim=True)
    centred = found - middle
    model_middle = complex_weight @ model.T  # [B, M]
    across = (complex_weight * centred) @ model.conj().T
    power = weight @ model.abs().square().T - model_middle.abs().square()
    turn = across / power.clamp_min(1e-12)
    explained = across.abs().square() / power.clamp_min(1e-12)
    left = (weight * centred.abs().square()).sum(1, keepdim=True) - explained
    return turn, middle - turn * model_middle, left.clamp_min(0.0).sqrt()


def _distinct(misfit: Tensor, views: Tensor, bends: int, count: int) -> Tensor:
    """The best `count` of [B, S V] whose view directions differ: [B, count]."""
    by_view = misfit.reshape(len(misfit), bends, len(views))
    least, bend = by_view.min(dim=1)  # [B, V]
    direction = views[:, 2]  # the hand's axis that points along the camera's
    near = (direction @ direction.T).clamp(-1, 1).acos() < _APART
    open_ = least.clone()
    chosen = []
    rows = torch.arange(len(misfit))
    for _ in range(count):
        view = open_.argmin(dim=1)
        chosen.append(bend[rows, view] * len(views) + view)
        open_ = open_.masked_fill(near[view], math.inf)
    return torch.stack(chosen, dim=1)

"""Posing in one pass against its twin in torch, and its gradients against finite differences."""

from __future__ import annotations

import pytest
import torch
from posing_twin import pose_twin
from torch import Tensor

from bigs.fused.posing import Posing, pose, skin
from bigs.geometry.rotations import axis_angle_to_matrix

B = 3


def random_subject(
    seed: int,
    count: int,
    bones: int,
    *,
    moving: bool,
    lit: bool,
    mirrored: bool,
    covered: bool = True,
    dtype=torch.float64,
) -> Posing:
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    turns = axis_angle_to_matrix(2.0 * random(B, bones, 3))
    affine = torch.cat([turns, random(B, bones, 3, 1)], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(B, bones, 1, 4)
    tensors = (
        random(B, count, 3) if moving else random(count, 3),
        random(count, bones).softmax(-1),
        torch.cat([affine, last], dim=-2) if moving else affine,
        random(count, 4),
        random(count, 3).sigmoid(),
        random(count, 3).softmax(-1) if lit else None,
        0.3 * random(B, 7) if lit else None,
        random(B, count).sigmoid() if lit and covered else None,
        0.5 * random(3) if lit and covered else None,
    )
    tensors = (
        None if t is None else t.to(dtype).requires_grad_(i not in (5, 7)) for i, t in enumerate(tensors)
    )
    return Posing(*tensors, mirrored=mirrored)


def random_clip(dtype=torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(9)
    return (0.3 * torch.randn(8, 3, generator=generator, dtype=torch.float64)).to(dtype).requires_grad_()


def scene(lit: bool, dtype=torch.float64, count: int = 130) -> list[Posing]:
    """More Gaussians than one piece of work holds, and a number that fills no vector."""
    return [
        random_subject(1, count, 16, moving=True, lit=lit, mirrored=True, dtype=dtype),
        random_subject(2, count + 7, 1, moving=False, lit=lit, mirrored=False, dtype=dtype),
        random_subject(3, 5, 3, moving=False, lit=lit, mirrored=True, covered=False, dtype=dtype),
    ]


def gradients(outputs: tuple[Tensor, ...], subjects: list[Posing], clip: Tensor | None) -> list[Tensor]:
    generator = torch.Generator().manual_seed(4)
    pulls = [torch.randn(out.shape, generator=generator, dtype=torch.float64) for out in outputs]
    inputs = [t for s in subjects for t in s if isinstance(t, Tensor) and t.requires_grad]
    inputs += [] if clip is None else [clip]
    return list(torch.autograd.grad(outputs, inputs, [p.to(o) for p, o in zip(pulls, outputs, strict=True)]))


@pytest.mark.parametrize("labels", [False, True])
@pytest.mark.parametrize("lit", [False, True])
def test_one_pass_is_the_twin(lit: bool, labels: bool) -> None:
    subjects, clip = scene(lit), random_clip() if lit else None
    found, expected = pose(subjects, clip, labels), pose_twin(subjects, clip, labels)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-13, rtol=1e-12)
    for a, b in zip(gradients(found, subjects, clip), gradients(expected, subjects, clip), strict=True):
        torch.testing.assert_close(a, b, atol=1e-10, rtol=1e-10)


def test_single_precision_is_near_double() -> None:
    single, double = scene(True, torch.float32), scene(True)
    found, expected = pose(single, random_clip(torch.float32), True), pose(double, random_clip(), True)
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a.double(), b, atol=1e-5, rtol=1e-5)


def test_gradients_are_finite_differences() -> None:
    subjects = [
        random_subject(1, 4, 3, moving=True, lit=True, mirrored=True),
        random_subject(2, 2, 1, moving=False, lit=True, mirrored=False),
    ]
    tensors = [t for s in subjects for t in s[:-1]]

    def posed(clip: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        return pose([Posing(*tensors[:9], mirrored=True), Posing(*tensors[9:])], clip, True)

    assert torch.autograd.gradcheck(posed, (random_clip(), *tensors))


def test_centres_alone_are_those_of_the_whole() -> None:
    for subject in scene(lit=False):
        alone, (whole, _, _) = skin(subject), pose([subject], None, False)
        assert torch.equal(alone, whole)
        inputs = subject[:3]
        pull = torch.linspace(-1, 1, whole.numel(), dtype=torch.float64).reshape(whole.shape)
        for a, b in zip(
            torch.autograd.grad(alone, inputs, pull), torch.autograd.grad(whole, inputs, pull), strict=True
        ):
            torch.testing.assert_close(a, b, atol=1e-12, rtol=1e-12)


def test_only_what_is_asked_for_gets_a_gradient() -> None:
    subject = random_subject(1, 9, 4, moving=False, lit=True, mirrored=False)
    frozen = Posing(*(None if t is None else t.detach() for t in subject[:-1]))
    only = frozen._replace(albedo=subject.albedo)
    (wanted,) = torch.autograd.grad(pose([subject], random_clip(), False)[2].sum(), subject.albedo)
    pose([only], random_clip().detach(), False)[2].sum().backward()
    assert torch.equal(only.albedo.grad, wanted)
    others = (only.points, only.weights, only.bones, only.quats, only.shade, only.ambient)
    assert all(t.grad is None for t in others)


def test_what_does_not_fit_is_refused() -> None:
    subject = random_subject(1, 9, 4, moving=False, lit=True, mirrored=False)
    for wrong in (
        subject._replace(points=subject.points[:5]),
        subject._replace(quats=subject.quats[:5]),
        subject._replace(shade=subject.shade[:, :5]),
        subject._replace(occlusion=subject.occlusion[:, :5].contiguous()),
        subject._replace(ambient=subject.ambient[:2].contiguous()),
        subject._replace(bones=subject.bones[:, :2]),
    ):
        with pytest.raises(ValueError, match="expected"):
            pose([wrong], random_clip(), False)
    with pytest.raises(ValueError, match="clip"):
        pose([subject], None, False)

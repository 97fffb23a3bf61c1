"""What a GPU computes with, on a CPU: half precision for all but the VAE gives nearly the same gradients."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from tiny_diffusion import SIZE
from torch import Tensor

from bigs.guidance import Conditions, SdsConfig, diffusers_folder, sds_loss
from bigs.guidance.crops import Crop
from bigs.guidance.diffusers import DiffusionConfig, load_stable_diffusion
from bigs.guidance.diffusers_folder import load_parts
from bigs.guidance.edges import soft_edges
from bigs.guidance.inversion import Inversion, InversionConfig

# Said by torch when the kernels are switched off.
pytestmark = pytest.mark.filterwarnings("ignore:TF32 acceleration on top of oneDNN:UserWarning")

HALVES = [torch.float16, torch.bfloat16]


@pytest.fixture(autouse=True)
def plain_kernels() -> Iterator[None]:
    """The accelerated half-precision kernels need instructions that virtual machines may not pass on."""
    with torch.backends.mkldnn.flags(enabled=False):
        yield


def use(monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype) -> None:
    monkeypatch.setattr(diffusers_folder, "choose", lambda *_: (torch.device("cpu"), dtype))


def alike(found: Tensor, expected: Tensor) -> float:
    return float(torch.nn.functional.cosine_similarity(found.flatten(), expected.flatten(), dim=0))


@pytest.mark.parametrize("dtype", HALVES)
def test_score_distillation(
    monkeypatch: pytest.MonkeyPatch, tiny_model: Path, tiny_controlnet: Path, dtype: torch.dtype
) -> None:
    gradients = []
    for precision in (torch.float32, dtype):
        use(monkeypatch, precision)
        config = DiffusionConfig(str(tiny_model), controlnet=str(tiny_controlnet), guidance_scale=7.0)
        images = torch.rand(1, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0)).requires_grad_()
        front = Conditions(torch.zeros(1), torch.zeros(1))
        generator = torch.Generator().manual_seed(0)
        prior = load_stable_diffusion(config)
        sds_loss(prior, images, front, SdsConfig(), progress=0.0, generator=generator).backward()
        assert images.grad is not None
        assert images.grad.dtype == torch.float32
        gradients.append(images.grad)
    assert alike(*gradients) > 0.99
    assert not torch.equal(*gradients)


@pytest.mark.parametrize("dtype", HALVES)
def test_textual_inversion(
    monkeypatch: pytest.MonkeyPatch, tiny_model: Path, tiny_controlnet: Path, dtype: torch.dtype
) -> None:
    """Its gradient is magnified on the way in float16, and must come out as large as it is."""
    picture = torch.randint(
        0, 255, (3, 48, 48), generator=torch.Generator().manual_seed(1), dtype=torch.uint8
    )
    crops = [Crop(picture, torch.full((1, 48, 48), 255, dtype=torch.uint8))]
    gradients = []
    for precision in (torch.float32, dtype):
        use(monkeypatch, precision)
        parts = load_parts(str(tiny_model), controlnet=str(tiny_controlnet))
        inversion = Inversion(parts, InversionConfig("mug"))
        assert parts.text_encoder.dtype == torch.float32
        inversion.take_step(crops, soft_edges)
        assert inversion.embedding.grad is not None
        gradients.append(inversion.embedding.grad)
    assert alike(*gradients) > 0.99
    assert float(gradients[1].norm() / gradients[0].norm()) == pytest.approx(1.0, abs=0.05)
    assert not torch.equal(*gradients)

"""One tiny diffusion model for all tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny_diffusion import write_controlnet, write_model


@pytest.fixture(scope="session", autouse=True)
def offline() -> Iterator[None]:
    """No test may reach for the network."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
        yield


@pytest.fixture(scope="session")
def tiny_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with Stable Diffusion in miniature. Read it, never write into it."""
    return write_model(tmp_path_factory.mktemp("diffusion") / "model")


@pytest.fixture(scope="session")
def tiny_controlnet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a ControlNet for it. Read it, never write into it."""
    return write_controlnet(tmp_path_factory.mktemp("diffusion") / "controlnet")

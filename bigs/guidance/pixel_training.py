"""How the small pixel-space denoiser learns from pictures of known views."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from bigs.guidance.denoiser import Conditions
from bigs.guidance.edges import soft_edges
from bigs.guidance.pixel import PixelConfig, PixelNet, cosine_alphas, view_features
from bigs.guidance.sds import add_noise


@dataclass(frozen=True)
class PixelTrainingConfig:
    """Length and manner of the training."""

    steps: int = 20_000
    batch: int = 32
    lr: float = 4e-4
    seed: int = 0
    # Edges and view are each hidden in this share of the pictures, so that the network learns to do without.
    # Edges are also blurred, shifted by up to this many pixels and thinned, as wrong as those of an
    # unfinished object.
    hide_edges: float = 0.4
    hide_view: float = 0.2
    edge_shift: int = 3
    net: PixelConfig = field(default_factory=PixelConfig)


class Pictures(NamedTuple):
    """Renderings of known views."""

    images: Tensor  # [N, 3, 64, 64] uint8
    azimuths: Tensor  # [N] radians
    elevations: Tensor  # [N]


class PixelTraining:
    """The network, its running mean, and the optimiser; what a step draws follows from seed and step."""

    def __init__(self, config: PixelTrainingConfig, device: torch.device) -> None:
        torch.manual_seed(config.seed)
        self.config, self.device, self.step = config, device, 0
        self.net = PixelNet(config.net).to(device)
        self.mean = copy.deepcopy(self.net).requires_grad_(False)
        self.optimizer = torch.optim.AdamW(self.net.parameters(), lr=config.lr, betas=(0.9, 0.99))
        self._alphas = cosine_alphas().to(device)

    def take_step(self, pictures: Pictures) -> float:
        """One step of AdamW on a random batch; the squared error of the velocity."""
        config = self.config
        draw = torch.Generator().manual_seed(1_000_003 * config.seed + self.step)
        chosen = torch.randint(len(pictures.images), (config.batch,), generator=draw)
        images = (pictures.images[chosen].float() / 255.0).to(self.device)
        timesteps = torch.randint(len(self._alphas), (config.batch,), generator=draw).to(self.device)
        noise = torch.randn(images.shape, generator=draw).to(self.device)
        edges_known = torch.rand(config.batch, generator=draw) >= config.hide_edges
        view_known = torch.rand(config.batch, generator=draw) >= config.hide_view
        edges = self._spoiled(soft_edges(images), draw) * edges_known.to(images)[:, None, None, None]
        conditions = Conditions(pictures.azimuths[chosen], pictures.elevations[chosen])
        views = view_features(conditions, edges_known, view_known).to(images)
        clean = 2.0 * images - 1.0
        a = self._alphas[timesteps][:, None, None, None]
        share = (timesteps.to(images) + 0.5) / len(self._alphas)
        found = self.net(add_noise(clean, noise, timesteps, self._alphas), share, edges, views)
        loss = (found - (a.sqrt() * noise - (1.0 - a).sqrt() * clean)).square().mean()
        # A short warm-up, then a decay to a tenth.
        progress = self.step / config.steps
        factor = min(1.0, (self.step + 1) / 100) * (1.0 - 0.9 * progress)
        for group in self.optimizer.param_groups:
            group["lr"] = config.lr * factor
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        # The running mean spans a tenth of the steps so far, at most a thousand.
        keep = 1.0 - 1.0 / min(1000.0, 1.0 + 0.1 * self.step)
        with torch.no_grad():
            for mean, value in zip(self.mean.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(value, 1.0 - keep)
        return float(loss.detach())

    def _spoiled(self, edges: Tensor, draw: torch.Generator) -> Tensor:
        reach = self.config.edge_shift
        rows, columns = torch.randint(-reach, reach + 1, (2,), generator=draw).tolist()
        blurred = torch.nn.functional.avg_pool2d(edges, 3, 1, 1)
        mixed = edges if float(torch.rand((), generator=draw)) < 0.5 else blurred
        thinned = torch.rand(edges.shape[0], 1, 8, 8, generator=draw) > 0.15
        holes = torch.nn.functional.interpolate(thinned.float(), edges.shape[-2:]).to(edges)
        return torch.roll(mixed, (rows, columns), (-2, -1)) * holes

    def state(self) -> dict[str, Tensor]:
        """Everything that is needed to go on, as tensors by name."""
        tensors = {f"net.{name}": value for name, value in self.net.state_dict().items()}
        tensors |= {f"mean.{name}": value for name, value in self.mean.state_dict().items()}
        for index, moments in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{key}": value for key, value in moments.items()}
        return {name: value.contiguous().cpu() for name, value in tensors.items()}

    def restore(self, tensors: dict[str, Tensor], step: int) -> None:
        """Go on from what `state` returned after `step` steps."""
        for part, module in (("net.", self.net), ("mean.", self.mean)):
            module.load_state_dict(
                {name.removeprefix(part): v for name, v in tensors.items() if name.startswith(part)}
            )
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            if name.startswith("optimizer."):
                _, index, key = name.split(".")
                moments.setdefault(int(index), {})[key] = value
        self.optimizer.load_state_dict(self.optimizer.state_dict() | {"state": moments})
        self.step = step

"""A float64 renderer that stays exact where `bigs.raster.reference` does not: needles, huge and tiny numbers.

No tiles, no culling: every pixel meets every Gaussian, gradients are autograd's. No determinant is taken as
ac − b², and `exact_whitening` repeats this one delicate step with 60 digits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mpmath
import torch

from bigs.raster import RasterSettings


class Footprints(NamedTuple):
    """Gaussians of one view, in the order given: exponent = −½ (u² + v²), u = a dx + b dy, v = c dy."""

    ids: torch.Tensor  # [M]
    means2d: torch.Tensor  # [M, 2]
    depths: torch.Tensor  # [M]
    rows: torch.Tensor  # [M, 2, 3]: the screen covariance is rows · rowsᵀ + eps2d
    whitening: torch.Tensor  # [M, 3]: a, b, c
    opacities: torch.Tensor  # [M]


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [N, 3, 3] of quaternions w x y z; the identity for zero."""
    largest = quats.detach().abs().amax(-1, keepdim=True)
    zero = largest == 0
    scaled = quats / torch.where(zero, 1.0, largest)
    unit = scaled / torch.where(zero, 1.0, torch.linalg.vector_norm(scaled, dim=-1, keepdim=True))
    vector = unit[:, 1:]
    x, y, z = vector.unbind(-1)
    nothing = torch.zeros_like(x)
    turn = torch.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing], -1).reshape(-1, 3, 3)
    # Rodrigues: I + 2 w [v]ₓ + 2 [v]ₓ²
    return torch.eye(3, dtype=quats.dtype) + 2 * unit[:, 0, None, None] * turn + 2 * turn @ turn


def footprints(inputs: dict[str, Any], settings: RasterSettings) -> Footprints:
    """Every Gaussian between the near and the far plane."""
    viewmat, K = inputs["viewmats"][0], inputs["Ks"][0]
    points = (viewmat[:3, :3] @ inputs["means"].T).T + viewmat[:3, 3]
    ids = torch.nonzero((points[:, 2] > settings.near_plane) & (points[:, 2] < settings.far_plane))[:, 0]
    x, y, z = points[ids].unbind(-1)
    focal = torch.stack([K[0, 0], K[1, 1]])
    centre = torch.stack([K[0, 2], K[1, 2]])
    size = torch.tensor([inputs["width"], inputs["height"]], dtype=points.dtype)
    slopes = torch.stack([x / z, y / z], -1)
    means2d = focal * slopes + centre
    held = slopes.clamp(-(centre + 0.15 * size) / focal, (size - centre + 0.15 * size) / focal)
    shape = viewmat[:3, :3] @ (rotations(inputs["quats"][ids]) * inputs["scales"][ids][:, None, :])
    rows = (focal / z[:, None])[..., None] * (shape[:, :2] - held[..., None] * shape[:, 2:])
    opacities = inputs["opacities"][ids]

    r0, r1 = rows.unbind(1)
    eps = settings.eps2d
    area = torch.linalg.cross(r0, r1).square().sum(-1)
    b, c = (r0 * r1).sum(-1), r1.square().sum(-1) + eps
    blur = eps * (r0.square().sum(-1) + r1.square().sum(-1)) + eps * eps
    det = area + blur
    root = (c / det).sqrt()
    if settings.antialiased:
        # √(area / det) in two forms: the gradient of the second cancels where the blur is little.
        wide = area > blur
        among_wide, among_thin = torch.where(wide, area, 1.0), torch.where(wide, 1.0, area)
        compensation = torch.where(wide, (1 + blur / among_wide).rsqrt(), (among_thin / det).sqrt())
        opacities = opacities * compensation
    return Footprints(ids, means2d, z, rows, torch.stack([root, -root * b / c, c**-0.5], -1), opacities)


def exact_whitening(rows: torch.Tensor, eps2d: float) -> torch.Tensor:
    """The whitening of `Footprints` with 60 digits, from ac − b² as it stands in the textbook."""
    result = []
    with mpmath.workdps(60):
        for r0, r1 in rows.tolist():
            dot = lambda p, q: mpmath.fsum(mpmath.mpf(i) * mpmath.mpf(j) for i, j in zip(p, q, strict=True))  # noqa: E731
            a, b, c = dot(r0, r0) + mpmath.mpf(eps2d), dot(r0, r1), dot(r1, r1) + mpmath.mpf(eps2d)
            root = mpmath.sqrt(c / (a * c - b * b))
            result.append([float(root), float(-root * b / c), float(1 / mpmath.sqrt(c))])
    return torch.tensor(result, dtype=torch.float64).reshape(-1, 3)


def render(
    inputs: dict[str, Any], settings: RasterSettings | None = None, depth: bool = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """Colors [1, H, W, D], depth as the last channel if asked for, and alphas [1, H, W, 1] of one view."""
    settings = settings or RasterSettings()
    width, height = inputs["width"], inputs["height"]
    screen = footprints(inputs, settings)
    order = torch.argsort(screen.depths, stable=True)
    a, b, c = screen.whitening[order].unbind(-1)
    columns = torch.arange(width, dtype=torch.float64).add(0.5).repeat(height)
    rows = torch.arange(height, dtype=torch.float64).add(0.5).repeat_interleave(width)
    dx = columns - screen.means2d[order, 0, None]
    dy = rows - screen.means2d[order, 1, None]
    exponents = -0.5 * ((a[:, None] * dx + b[:, None] * dy).square() + (c[:, None] * dy).square())
    raw = screen.opacities[order, None] * exponents.exp()
    alphas = raw.clamp(max=settings.max_alpha)
    # An Gaussian of no or negative opacity is not there, even where no alpha is too faint.
    seen = (alphas >= settings.alpha_threshold) & (screen.opacities[order, None] >= 0)
    alphas = torch.where(seen, alphas, torch.zeros_like(alphas))
    live = torch.cumprod(1 - alphas.detach(), 0) > settings.min_transmittance
    alphas = torch.where(live, alphas, torch.zeros_like(alphas))
    behind = torch.cumprod(1 - alphas, 0)
    before = torch.cat([torch.ones(1, width * height, dtype=torch.float64), behind])
    values = inputs["colors"][screen.ids[order]]
    background = inputs.get("backgrounds")
    background = torch.zeros_like(inputs["colors"][:1].sum(0)) if background is None else background[0]
    if depth:
        values = torch.cat([values, screen.depths[order, None]], -1)
        background = torch.cat([background, background.new_zeros(1)])
    image = (alphas * before[:-1]).T @ values + before[-1][:, None] * background
    return image.reshape(1, height, width, -1), (1 - before[-1]).reshape(1, height, width, 1)


def gradients(
    inputs: dict[str, Any], names: tuple[str, ...], settings: RasterSettings | None = None, seed: int = 0
) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
    """As `raster_scenes.gradients`: colors, alphas and gradients under the same random cotangents."""
    leaves = {k: inputs[k].detach().clone().requires_grad_() for k in names if inputs.get(k) is not None}
    colors, alphas = render({**inputs, **leaves}, settings)
    g = torch.Generator().manual_seed(seed)
    v = [torch.randn(x.shape, generator=g, dtype=torch.float64) for x in (colors, alphas)]
    found = torch.autograd.grad(
        [colors, alphas], list(leaves.values()), v, allow_unused=True, materialize_grads=True
    )
    return colors.detach(), alphas.detach(), dict(zip(leaves, found, strict=True))

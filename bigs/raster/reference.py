"""The slow, obvious twin of the engine: every pixel against every Gaussian, gradients by autograd.

No tiles, no culling, no shared code with the engine. Memory is pixels × Gaussians per view: for small scenes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from numpy.polynomial import Legendre, Polynomial

from bigs.raster.settings import RasterSettings


class _Screen(NamedTuple):
    """Gaussians of one view on the screen, front to back."""

    means2d: torch.Tensor  # [M, 2] pixels
    covs2d: torch.Tensor  # [M, 2, 2] px², with eps2d on the diagonal
    depths: torch.Tensor  # [M] camera z
    opacities: torch.Tensor  # [M]
    ids: torch.Tensor  # [M] which Gaussian


def rasterize_view(
    means: torch.Tensor,  # [N, 3]
    quats: torch.Tensor,  # [N, 4]
    scales: torch.Tensor,  # [N, 3]
    opacities: torch.Tensor,  # [N]
    colors: torch.Tensor,  # [N, D]
    viewmat: torch.Tensor,  # [4, 4]
    K: torch.Tensor,  # [3, 3]
    width: int,
    height: int,
    settings: RasterSettings,
    background: torch.Tensor | None,  # [D]
    pixel_mask: torch.Tensor | None,  # [H, W]
    render_mode: str,
    camera_model: str,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
    """Render one view: colors [H, W, D], alphas [H, W, 1], and means2d [N, 2], depths [N], radii [N, 2].

    Inputs are those of `bigs.raster.rasterization`, checked.
    """
    screen, info = _project(
        means, quats, scales, opacities, viewmat, K, width, height, settings, camera_model
    )
    channels = []
    if "RGB" in render_mode:
        channels.append(colors[screen.ids])
    if "D" in render_mode.split("+")[-1]:
        channels.append(screen.depths[:, None])
    image, transmittance, medians = _composite(screen, torch.cat(channels, dim=-1), width, height, settings)
    if pixel_mask is not None:
        medians = torch.where(pixel_mask.reshape(-1), medians, -1)
    of_none = torch.tensor([-1], device=medians.device)  # selected by index −1
    info["median_ids"] = torch.cat([screen.ids, of_none])[medians].reshape(height, width).int()
    depths = torch.cat([screen.depths, screen.depths.new_zeros(1)])[medians]
    info["render_median"] = depths.reshape(height, width, 1)

    behind = torch.zeros_like(image[:1])
    if background is not None and "RGB" in render_mode:
        behind = torch.cat([background, background.new_zeros(image.shape[-1] - len(background))])[None]
    alphas = 1 - transmittance[:, None]
    image = image + transmittance[:, None] * behind
    if render_mode.endswith("ED"):
        # gsplat's rule for pixels with hardly any alpha
        expected = image[:, -1:] / alphas.clamp(min=1e-10)
        image = torch.cat([image[:, :-1], expected], dim=-1)
    if pixel_mask is not None:
        inside = pixel_mask.reshape(-1, 1)
        image = torch.where(inside, image, behind.detach())
        alphas = torch.where(inside, alphas, torch.zeros_like(alphas))
    return image.reshape(height, width, -1), alphas.reshape(height, width, 1), info


def _rotations(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [N, 3, 3] of quaternions w x y z of any length; the identity for zero."""
    lengths = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
    degenerate = lengths == 0
    unit = torch.where(degenerate, torch.zeros_like(quats), quats / torch.where(degenerate, 1.0, lengths))
    w, x, y, z = unit.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _pinhole(
    points: torch.Tensor, K: torch.Tensor, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Camera points [M, 3] in pixels [M, 2], and the derivative [M, 2, 3] that Gaussians are shaped with."""
    x, y, z = points.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)

    # Slopes in the Jacobian are clamped to 1.3 × half the field of view, measured from the image border.
    margin_x, margin_y = 0.15 * width, 0.15 * height
    slope_x = (x / z).clamp(min=-(cx + margin_x) / fx, max=(width - cx + margin_x) / fx)
    slope_y = (y / z).clamp(min=-(cy + margin_y) / fy, max=(height - cy + margin_y) / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([fx / z, zero, -fx * slope_x / z], dim=-1),
            torch.stack([zero, fy / z, -fy * slope_y / z], dim=-1),
        ],
        dim=-2,
    )
    return means2d, jacobian


def _orthographic(
    points: torch.Tensor, K: torch.Tensor, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same along parallel rays: K maps metres to pixels wherever they are."""
    flat = torch.cat([K[:2, :2], torch.zeros_like(K[:2, :1])], dim=-1)
    return points @ flat.T + K[:2, 2], flat


def _project(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    viewmat: torch.Tensor,
    K: torch.Tensor,
    width: int,
    height: int,
    settings: RasterSettings,
    camera_model: str,
) -> tuple[_Screen, dict[str, torch.Tensor]]:
    """EWA splatting: the Gaussian under the Jacobian of the projection at its centre (Zwicker 2001)."""
    in_front = means @ viewmat[2, :3] + viewmat[2, 3]
    ids = torch.nonzero((in_front > settings.near_plane) & (in_front < settings.far_plane))[:, 0]
    points = means[ids] @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = points[:, 2]
    lens = _orthographic if camera_model == "ortho" else _pinhole
    means2d, jacobian = lens(points, K, width, height)
    axes = jacobian @ viewmat[:3, :3] @ (_rotations(quats[ids]) * scales[ids][:, None, :])  # [M, 2, 3]
    sharp = axes @ axes.transpose(-1, -2)
    covs2d = sharp + settings.eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    visible_opacities = opacities[ids]
    if settings.antialiased:
        ratio = torch.linalg.det(sharp) / torch.linalg.det(covs2d)
        visible_opacities = visible_opacities * ratio.clamp(min=0).sqrt()

    keep = (visible_opacities >= settings.alpha_threshold) & (torch.linalg.det(covs2d) > 0)
    radii = torch.full_like(means2d, math.inf)
    if settings.alpha_threshold > 0:
        reach = 2 * torch.log(
            visible_opacities.clamp(min=settings.alpha_threshold) / settings.alpha_threshold
        )
        radii = (reach[:, None] * torch.diagonal(covs2d, dim1=-2, dim2=-1)).sqrt()
    size = torch.tensor([width, height], dtype=means.dtype, device=means.device)
    keep &= ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
    if settings.radius_clip > 0:
        keep &= (radii > settings.radius_clip).any(-1)

    order = torch.nonzero(keep)[:, 0]
    info = {
        "means2d": torch.zeros(len(means), 2, dtype=means.dtype, device=means.device),
        "depths": torch.zeros(len(means), dtype=means.dtype, device=means.device),
        "radii": torch.zeros(len(means), 2, dtype=torch.int32, device=means.device),
    }
    info["means2d"] = info["means2d"].index_put((ids[order],), means2d[order])
    info["depths"][ids[order]] = z[order].detach()
    info["radii"][ids[order]] = radii[order].detach().ceil().clamp(max=2.0**31 - 128).int()
    order = order[torch.argsort(z[order], stable=True)]
    # Taken from info, so that callers can ask for the gradient of the centres.
    return _Screen(
        info["means2d"][ids[order]], covs2d[order], z[order], visible_opacities[order], ids[order]
    ), info


def _composite(
    screen: _Screen, values: torch.Tensor, width: int, height: int, settings: RasterSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Blend values [M, D] front to back (paper Eq. 2).

    Returns:
        [H·W, D], the transmittance left over [H·W], and which of M is the median [H·W], −1 for none.
    """
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([columns, rows], dim=-1).reshape(1, -1, 2).to(values) + 0.5
    offsets = pixels - screen.means2d[:, None, :]  # [M, P, 2]
    exponents = -0.5 * torch.einsum("mpi,mij,mpj->mp", offsets, torch.linalg.inv(screen.covs2d), offsets)
    alphas = (screen.opacities[:, None] * exponents.exp()).clamp(max=settings.max_alpha)
    hit = alphas >= settings.alpha_threshold
    alphas = torch.where(hit, alphas, torch.zeros_like(alphas))
    # A pixel stops before the Gaussian that would bring its transmittance to the limit.
    live = torch.cumprod(1 - alphas.detach(), dim=0) > settings.min_transmittance
    alphas = torch.where(live, alphas, torch.zeros_like(alphas))
    after = torch.cumprod(1 - alphas, dim=0)
    before = torch.cat([torch.ones_like(after[:1]), after], dim=0)
    # The last Gaussian that more than half the light reaches.
    places = torch.arange(len(values), device=values.device)[:, None]
    reached = torch.where((alphas > 0) & (before[:-1] > 0.5), places, -1)
    medians = torch.cat([reached.new_full((1, reached.shape[1]), -1), reached]).amax(0)
    return (alphas * before[:-1]).T @ values, before[-1], medians


def harmonics(degree: int, dirs: torch.Tensor, coeffs: torch.Tensor) -> torch.Tensor:
    """Real spherical harmonics [..., 3] of coefficients [..., K, 3] along directions [..., 3] of any length.

    From the general formula: order m has cos or sin of |m| times the azimuth, an associated Legendre function
    of z with the Condon-Shortley phase, and a factor that makes the integral of its square 1.
    """
    unit = torch.nn.functional.normalize(dirs, dim=-1)
    x, y, z = unit.unbind(-1)
    rim = torch.complex(x, y)  # sin(polar angle) · exp(i · azimuth), smooth at the poles too
    colors = torch.zeros_like(dirs)
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            m = abs(order)
            # Rodrigues: the m-th derivative of the Legendre polynomial of this band, a polynomial in z.
            polynomial = Legendre.basis(band).deriv(m) if m else Legendre.basis(band)
            powers = polynomial.convert(kind=Polynomial).coef
            along = sum(float(c) * z**p for p, c in enumerate(powers))
            scale = math.sqrt(
                (2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m)
            )
            around = torch.ones_like(z)
            if m:
                spun = rim**m
                around = (-1) ** m * math.sqrt(2) * (spun.real if order > 0 else spun.imag)
            colors = colors + (scale * along * around)[..., None] * coeffs[..., band * band + band + order, :]
    return colors

"""Every threshold of the renderer, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RasterSettings:
    """The rules of the renderer. The defaults are gsplat's, so that images agree."""

    tile_size: int = 32
    """Side of a square tile in pixels: 4, 8, 16 or 32. A tile has one ordered list; 32 measured fastest."""
    eps2d: float = 0.3
    """Added to both variances on screen, in px²: a Gaussian thinner than a pixel still covers one."""
    near_plane: float = 0.01
    """Gaussians whose centre has a smaller camera z are skipped: projection is singular at 0."""
    far_plane: float = 1e10
    """Gaussians whose centre has a larger camera z are skipped."""
    radius_clip: float = 0.0
    """Gaussians whose radii on screen are both at most this many pixels are skipped; 0 keeps all."""
    alpha_threshold: float = 1.0 / 255.0
    """A (pixel, Gaussian) pair with alpha below this is skipped: 8 bits cannot show it. 0 skips none."""
    max_alpha: float = 0.999
    """Alpha is limited to this, so that transmittance never reaches 0 and gradients stay finite."""
    min_transmittance: float = 1e-4
    """A pixel stops before the Gaussian that would bring its transmittance to this or less. 0 never stops."""
    exp_degree: int = 5
    """Degree of the polynomial for powers of two: 3, 4 or 5; relative errors of alpha are 1e-4, 3e-6, 1e-7.
    float64 has one of degree 12, and only takes 5 here."""
    antialiased: bool = False
    """Scale opacities by what `eps2d` added to the area (Mip-Splatting): thin ones do not grow brighter."""

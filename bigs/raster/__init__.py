"""Differentiable splatting: one call, several backends behind it."""

from bigs.raster.api import rasterization
from bigs.raster.settings import RasterSettings
from bigs.raster.sh import spherical_harmonics

__all__ = ["RasterSettings", "rasterization", "spherical_harmonics"]

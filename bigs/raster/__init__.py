"""Differentiable splatting: one call, several backends behind it."""

from bigs.raster.api import rasterization
from bigs.raster.settings import RasterSettings

__all__ = ["RasterSettings", "rasterization"]

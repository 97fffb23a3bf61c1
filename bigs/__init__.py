"""bigs: two hands and the unknown object they hold, as 3D Gaussians, from one ordinary video, on a CPU."""

from importlib.metadata import version

__version__ = version("bigs")

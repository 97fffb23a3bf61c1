"""bigs: two hands and the unknown object they hold, as 3D Gaussians, from one ordinary video, on a CPU."""

import os
from importlib.metadata import version

# OpenMP threads that wait for each other by spinning stop all progress as soon as another program wants a
# core: a step of 0.4 s was measured at 5.6 s. Read once, when torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = version("bigs")

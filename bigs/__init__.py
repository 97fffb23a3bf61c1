"""bigs: two hands and the unknown object they hold, as 3D Gaussians, from one ordinary video, on a CPU."""

import os
from importlib.metadata import version

# OpenMP threads that spin while they wait block the renderer's threads, and any other program makes that many
# times worse (docs/design/waiting-threads.md). torch reads this once, on import.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = version("bigs")

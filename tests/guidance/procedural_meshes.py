"""The family of objects of `examples/train_prior.py`."""

from __future__ import annotations

import importlib.util
from pathlib import Path

_PATH = Path(__file__).parents[2] / "examples" / "train_prior.py"
_SPEC = importlib.util.spec_from_file_location("example_train_prior", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
_EXAMPLE = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(_EXAMPLE)

write_meshes = _EXAMPLE.write_meshes

"""A workload folder's own reference, which shares no code with bigs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bigs.bench.workloads import PARAMETERS, WorkloadSpec, folder_module

# The reference of larger workloads takes minutes; it is used only if it lies in a file.
_QUICK = 10_000


def folder_truth(spec: WorkloadSpec) -> dict[str, np.ndarray] | None:
    """Image and gradients by the folder's reference: from NAME_ref.npz, or computed where that is quick.

    None for a workload of our own, or one that would take minutes.
    """
    if spec.folder is None:
        return None
    file = Path(spec.folder) / f"{spec.name}_ref.npz"
    if file.is_file():
        with np.load(file) as arrays:
            found = dict(arrays)
    else:
        module = folder_module(spec.folder)
        workload = module.make_workload(spec.name)
        if len(workload["means"]) > _QUICK:
            return None
        found = module.render_reference(workload)
    return {"image": found["image"], **{name: found[f"g_{name}"] for name in PARAMETERS}}

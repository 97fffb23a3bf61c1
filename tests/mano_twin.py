"""A hand posed joint by joint in plain numpy, from the definition: what the datasets' poses must mean."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bigs.hand import HandModel
from bigs.hand.model import MANO_PARENTS
from bigs.types import Side


def odd_models(models: dict[Side, HandModel]) -> dict[Side, HandModel]:
    """Hands as in MANO's files: a mean pose, and a left hand whose shapes have the right hand's x sign."""
    rng = np.random.default_rng(11)
    mean = 0.2 * rng.normal(size=(15, 3))
    changed: dict[Side, HandModel] = {}
    for side, model in models.items():
        shapedirs = model.shapedirs.numpy() * ([[-1.0], [1.0], [1.0]] if side == "left" else 1.0)
        changed[side] = HandModel(
            side,
            v_template=model.v_template,
            faces=model.faces,
            shapedirs=shapedirs,
            posedirs=1e-3 * rng.normal(size=model.posedirs.shape),
            J_regressor=model.J_regressor,
            lbs_weights=model.lbs_weights,
            hands_mean=mean * ([1, -1, -1] if side == "left" else [1, 1, 1]),
            tip_vertex_ids=model.tip_vertex_ids,
        )
    return changed


def pose_mano(
    model: HandModel,
    global_orient: np.ndarray,
    hand_pose_absolute: np.ndarray,
    transl: np.ndarray,
    betas: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """One frame's vertices [V, 3] and 21 joints: LBS about the rest joints, then plus `transl`."""
    arrays = {name: tensor.double().numpy() for name, tensor in model.named_buffers()}
    shaped = arrays["v_template"] + arrays["shapedirs"] @ betas
    rest = arrays["J_regressor"] @ shaped
    turns = Rotation.from_rotvec(np.vstack([global_orient, hand_pose_absolute])).as_matrix()
    corrective = arrays["posedirs"] @ (turns[1:] - np.eye(3)).reshape(-1)
    chain = []
    for joint, parent in enumerate(MANO_PARENTS):
        own = np.eye(4)
        own[:3, :3] = turns[joint]
        own[:3, 3] = rest[joint] - (rest[parent] if joint else 0)
        chain.append(chain[parent] @ own if joint else own)
    verts = np.zeros_like(shaped)
    for joint, weights in enumerate(arrays["lbs_weights"].T):
        local = shaped + corrective - rest[joint]
        verts += weights[:, None] * (local @ chain[joint][:3, :3].T + chain[joint][:3, 3])
    verts += transl
    joints = np.array([bone[:3, 3] for bone in chain]) + transl
    return verts, np.vstack([joints, verts[model.tip_vertex_ids.numpy()]])

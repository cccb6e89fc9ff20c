"""Opening of the doors and blinds of a simulated room."""

from typing import Any

import mujoco


def opening(model: Any, data: Any, joint: str, *, missing: float = 0.0) -> float:
    """Position of a joint as a share of its range, 0…1.

    Args:
        model: ``MjModel``.
        data: ``MjData``.
        joint: Joint name.
        missing: Result if the room has no such joint.
    """
    index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint))
    if index < 0:
        return missing
    lower, upper = model.jnt_range[index].tolist()
    return float(min(1.0, max(0.0, (data.qpos[model.jnt_qposadr[index]] - lower) / (upper - lower))))

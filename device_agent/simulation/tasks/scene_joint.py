"""One joint of a scene, as that of a drawer, which a reset sets."""

from typing import Any

import mujoco

from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests import tasks
from device_agent.simulation.mjcf.equality_joints import SCALAR_JOINTS


class ArticulatedJoint:
    """Indices of a joint, its body, and the shapes that move with it.

    Attributes:
        index: Its body.
        qpos: Index of its position in ``qpos``.
        dof: Index of its velocity in ``qvel``.
        geoms: Indices of the shapes that it moves.

    Args:
        model: The compiled ``MjModel``.
        name: Name of the joint.

    Raises:
        DriverError: The joint is missing, or is neither a hinge nor a slide.
    """

    def __init__(self, model: Any, name: str) -> None:
        joint = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name))
        if joint < 0 or model.jnt_type[joint] not in SCALAR_JOINTS:
            raise DriverError(f"{tasks.MANIFEST}: the scene has no hinge or slide joint '{name}'")
        self.index = int(model.jnt_bodyid[joint])
        self.qpos, self.dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        moved = subtree(model, {self.index})
        self.geoms = tuple(geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in moved)

    def set_position(self, data: Any, position: float) -> None:
        """Set the position [m or rad]."""
        data.qpos[self.qpos] = position

    def set_resistance(self, model: Any, friction: float, damping: float) -> None:
        """Set friction [N or N m] and damping [N s/m or N m s/rad]."""
        model.dof_frictionloss[self.dof], model.dof_damping[self.dof] = friction, damping


def subtree(model: Any, bodies: set[int]) -> set[int]:
    """Bodies, and all bodies below them."""
    below = set(bodies)
    for body in range(1, model.nbody):
        if int(model.body_parentid[body]) in below:
            below.add(body)
    return below

"""Every robot folder of the project, so that a new one is tested without a new line of code.

Types in the folders of ``TELESCOPE_ROBOTS_PATH`` are tested as well.
"""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.config import catalogue
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROBOTS

FOLDERS = sorted(path.parent for place in catalogue.search_paths() for path in place.glob("*/robot.toml"))
SHIPPED = [folder for folder in FOLDERS if folder.parent == ROBOTS]
MOVEMENTS = sorted(path for folder in FOLDERS for path in (folder / robot_type.MOVEMENTS).glob("*.py"))


class SteppedRobot:
    """One robot type's scene, stepped manually without a driver."""

    def __init__(self, folder: Path) -> None:
        self.type = robot_type.load(folder)
        self.model: Any = mujoco.MjModel.from_xml_path(str(folder / self.type.scene))
        self.data: Any = mujoco.MjData(self.model)
        self.names = [joint.name for joint in self.type.joints]
        joints = [self.model.joint(name) for name in self.names]
        self.qpos = np.array([joint.qposadr[0] for joint in joints])
        self.dof = np.array([joint.dofadr[0] for joint in joints])
        self.ctrl = np.array([self.model.actuator(name).id for name in self.names])
        self.lower = np.array([joint.lower_rad for joint in self.type.joints])
        self.upper = np.array([joint.upper_rad for joint in self.type.joints])
        self.home = np.array([self.type.home_rad[name] for name in self.names])
        self.place(self.home)

    def place(self, position: npt.NDArray[Any], velocity: npt.NDArray[Any] | float = 0.0) -> None:
        """Put every joint and its servo at a position, in a reset simulation."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.qpos] = position
        self.data.qvel[self.dof] = velocity
        self.data.ctrl[self.ctrl] = position
        mujoco.mj_forward(self.model, self.data)

    def step(self, count: int = 1) -> None:
        mujoco.mj_step(self.model, self.data, nstep=count)


def contacts(model: Any, data: Any, *, only: int | None = None) -> set[tuple[str, str]]:
    """Pairs of bodies in contact; with ``only`` the pairs inside the robot with this base."""
    pairs = set()
    for contact in data.contact[: data.ncon]:
        bodies = [int(model.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2)]
        if only is None or {int(model.body_rootid[body]) for body in bodies} == {only}:
            first, second = sorted(model.body(body).name for body in bodies)
            pairs.add((first, second))
    return pairs

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


class Bench:
    """One robot type's scene on the bench, stepped by hand, without the driver under test elsewhere."""

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
        self.speed = np.array([joint.max_velocity_rad_s for joint in self.type.joints])
        self.acceleration = np.array([joint.max_acceleration_rad_s2 for joint in self.type.joints])
        self.home = np.array([self.type.home_rad[name] for name in self.names])
        self.place(self.home)

    def place(self, position: npt.NDArray[Any], velocity: npt.NDArray[Any] | float = 0.0) -> None:
        """Put every joint somewhere, with its servo at the same place, and forget the past."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.qpos] = position
        self.data.qvel[self.dof] = velocity
        self.data.ctrl[self.ctrl] = position
        mujoco.mj_forward(self.model, self.data)

    def touching(self) -> set[tuple[str, str]]:
        """Pairs of bodies in contact."""
        names = [
            sorted(self.model.body(self.model.geom_bodyid[geom]).name for geom in (contact.geom1, contact.geom2))
            for contact in self.data.contact[: self.data.ncon]
        ]
        return {(first, second) for first, second in names}


def heard(kind: robot_type.RobotType, yaw_rad: float) -> dict[str, Any]:
    """What a robot that is turned so measures in an empty hall; its own tests have walls."""
    measured = {
        "sonar": {"distance_m.left": 4.0, "distance_m.right": 4.0},
        "odometry": {"yaw_rad": yaw_rad},
    }
    streams = [stream.name for stream in kind.streams if stream.name in measured]
    return {name: {"values": measured[name], "age_s": 0.0} for name in streams}


def whereabouts(kind: robot_type.RobotType, x_m: float, y_m: float, yaw_rad: float) -> dict[str, Any]:
    """Room data with a robot at its position and a person in front of it."""
    values = {"age_s.person": 0.1, "x_m.person": 1.9, "y_m.person": 0.35}
    name = kind.type
    values |= {f"age_s.{name}": 0.1, f"x_m.{name}": x_m, f"y_m.{name}": y_m, f"yaw_rad.{name}": yaw_rad}
    return {"values": values, "age_s": 0.1}

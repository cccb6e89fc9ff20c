"""Shape of a robot of which only the joints are measured: its twin and the poses of its frames."""

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from device_agent.ports.driver import DriverError
from device_agent.protocol import Pose, Twin
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.equality_joints import EqualityJoints
from device_agent.simulation.mjcf.twin import build_twin


class RobotModel:
    """The MJCF model of a robot type, for drivers of real robots. Compiled at the first use. Thread-safe.

    Args:
        robot_type: Joints and frames.
        folder: Folder of the robot type.
    """

    def __init__(self, robot_type: RobotType, folder: Path) -> None:
        self._type = robot_type
        self._path = folder / robot_type.model
        self._lock = threading.Lock()
        self._compiled: _Compiled | None = None

    def twin(self, device: str) -> Twin | None:
        """The robot as ``Driver.twin`` returns it; ``None`` if the type has no model.

        Raises:
            DriverError: The model cannot be built.
        """
        if not self._type.model:
            return None
        with self._lock:
            compiled = self._load()
            return build_twin(compiled.model, base=compiled.base, device=device)

    def frames(self, position_rad: Sequence[float]) -> tuple[Pose, ...]:
        """Poses of the type's ``frames`` in the base frame, for joint positions of shape (n,) [rad].

        Raises:
            DriverError: The model cannot be built, or lacks a joint or frame of the type.
        """
        if not self._type.frames:
            return ()
        with self._lock:
            return self._load().poses(position_rad)

    def _load(self) -> "_Compiled":
        if self._compiled is None:
            try:
                self._compiled = _Compiled(mujoco.MjModel.from_xml_path(str(self._path)), self._type)
            except (ValueError, OSError, KeyError, mujoco.FatalError) as error:
                raise DriverError(f"{self._path}: MuJoCo cannot build this model: {error}") from error
        return self._compiled


class _Compiled:
    """A compiled model. Raises ``KeyError`` if it lacks a joint or frame of the type."""

    def __init__(self, model: Any, robot_type: RobotType) -> None:
        self.model = model
        self._data = mujoco.MjData(model)
        self._equality_joints = EqualityJoints(model)
        joints = [model.joint(joint.name).id for joint in robot_type.joints]
        self._qpos = np.array([model.jnt_qposadr[joint] for joint in joints], dtype=np.intp)
        self.base = int(model.body_rootid[model.jnt_bodyid[joints[0]]]) if joints else 1
        self._frames = [self._frame(name) for name in robot_type.frames]

    def _frame(self, name: str) -> tuple[bool, int]:
        site = int(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, name))
        return (True, site) if site >= 0 else (False, int(self.model.body(name).id))

    def poses(self, position_rad: Sequence[float]) -> tuple[Pose, ...]:
        self._data.qpos[self._qpos] = position_rad
        self._equality_joints.apply(self._data.qpos)
        mujoco.mj_kinematics(self.model, self._data)
        return tuple(self._pose(is_site, index) for is_site, index in self._frames)

    def _pose(self, is_site: bool, index: int) -> Pose:
        data = self._data
        back = data.xmat[self.base].reshape(3, 3).T
        position = data.site_xpos[index] if is_site else data.xpos[index]
        matrix = (data.site_xmat[index] if is_site else data.xmat[index]).reshape(3, 3)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, (back @ matrix).ravel())
        x, y, z = (back @ (position - data.xpos[self.base])).tolist()
        w, i, j, k = (quaternion if quaternion[0] >= 0 else -quaternion).tolist()
        return (x, y, z, w, i, j, k)

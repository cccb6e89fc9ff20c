"""A robot's shape in MuJoCo: where its frames are, how near things are, how far a way is clear."""

import math
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.geometry.pairs import ROOM_PREFIX, Pairs
from device_agent.geometry.solver import Solver
from device_agent.geometry.standing import Standing
from device_agent.mjcf.ties import Ties
from device_agent.ports.geometry import Clearance, GeometryError, Sweep
from device_agent.protocol.messages import Pose
from device_agent.protocol.robot_type import RobotType

Floats = npt.NDArray[np.float64]

_STEP_M = 0.01
"""What comes nearer by less than this, and goes away again, may be missed: half of the usual margin."""
_GLANCES = 6
_CLOSER = 3
"""How often the place is halved in which a glance finds a way to end."""
_SAME_M = 1e-7
"""Less than this is no change of a distance: far above rounding, far below what creeping could add up to."""


class MujocoGeometry:
    """The robot of one type in its scene. Joints without a motor of their own go with those that they are tied to.

    Distances are between collision shapes (``mj_geomDistance``), so what the picture shows may be smaller, not larger.

    Args:
        robot_type: Joints, frames, workspace, margin.
        scene: MJCF file that holds the robot.
        standing: The room to put it into.

    Raises:
        GeometryError: The scene cannot be read, lacks a joint or frame of the manifest, or the robot touches something
            in its home position.
    """

    def __init__(self, robot_type: RobotType, scene: Path, *, standing: Standing | None = None) -> None:
        try:
            self._model: Any = _spec(scene, standing).compile()
        except (ValueError, OSError, mujoco.FatalError) as error:
            where = scene if standing is None else f"{scene} in {standing.room}"
            raise GeometryError(f"{where}: MuJoCo cannot build this model: {error}") from error
        self._data = mujoco.MjData(self._model)
        self._lock = threading.Lock()
        self._type = robot_type
        self._ties = Ties(self._model)
        joints = [self._find(mujoco.mjtObj.mjOBJ_JOINT, "joint", joint.name) for joint in robot_type.joints]
        self._qpos = np.array([self._model.jnt_qposadr[joint] for joint in joints], dtype=np.intp)
        self._base = int(self._model.body_rootid[self._model.jnt_bodyid[joints[0]]]) if joints else 0
        self._frames = {name: self._frame(name) for name in robot_type.frames}
        self._home = np.array([robot_type.home_rad[joint.name] for joint in robot_type.joints])
        lower = np.array([joint.lower_rad for joint in robot_type.joints])
        upper = np.array([joint.upper_rad for joint in robot_type.joints])
        self._place(self._home)
        self._pairs = Pairs(self._model, robot_type, joints, self._frames, base=self._base, ties=self._ties)
        self._pairs.calibrate(self._data, self._place, home=self._home, lower=lower, upper=upper)
        self._place(self._home)
        self._measured = self._home, self._pairs.rooms_at_least(self._data)
        self._solver = Solver(self._model, self._qpos, self._frames, lower=lower, upper=upper)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames."""
        return tuple(self._frames)

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        """Pose of each frame in the robot's base frame."""
        with self._lock:
            self._place(position_rad)
            return {name: self._pose(is_site, index) for name, (is_site, index) in self._frames.items()}

    def clearance(self, position_rad: Sequence[float]) -> Clearance:
        """The tightest place of the robot in one position."""
        with self._lock:
            self._place(position_rad)
            return self._pairs.tightest(self._data)

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        """Go from one joint position straight to the next until something is too near, or nearer than it was."""
        path = np.asarray(path_rad, dtype=np.float64)
        legs = np.diff(path, axis=0)
        with self._lock:
            if self._surely_clear(path):
                return Sweep(1.0)
            self._place(path[0])
            near = self._pairs.near(self._data, np.abs(legs))
            for index, leg in enumerate(legs):
                share = 0.0
                while share < 1.0 and near.any:
                    gone = share
                    share = min(1.0, share + near.safe_share(index, _STEP_M))
                    self._place(path[index] + share * leg)
                    near.look(self._data, index, share)
                    if near.broken(_SAME_M):
                        return Sweep((index + gone) / len(legs), near.tightest())
            return Sweep(1.0)

    def _surely_clear(self, path: Floats) -> bool:
        """Whether nothing can come too near, by the room there was where it was last measured: most ways, cheaply.

        How near a pair may have come grows with each joint's distance from there, so the corners of a path tell it all.
        Measured anew where that does not suffice.
        """
        if self._within(path):
            return True
        self._place(path[0])
        self._measured = path[0], self._pairs.rooms_at_least(self._data)
        return self._within(path)

    def _within(self, path: Floats) -> bool:
        origin, room_m = self._measured
        return bool(np.all(self._pairs.closing(np.abs(path - origin)) <= room_m))

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        """The share of a straight way that seems clear, by six places on it, and three where it ends."""
        start, way = np.asarray(start_rad, dtype=np.float64), np.subtract(end_rad, start_rad)
        with self._lock:
            self._place(start)
            before = self._pairs.too_near(self._data)

            def clear(share: float) -> bool:
                there = start + share * way
                if self._within(there[np.newaxis]):
                    return True
                self._place(there)
                return self._pairs.too_near(self._data) <= before

            for index in range(_GLANCES):
                if not clear((index + 1) / _GLANCES):
                    low, half = index / _GLANCES, 0.5 / _GLANCES
                    for _ in range(_CLOSER):
                        low, half = (low + half if clear(low + half) else low), half / 2
                    return low
            return 1.0

    def speed_m_s(self, velocity_rad_s: Sequence[float]) -> float:
        """A speed that no point of the robot exceeds [m/s]."""
        return self._pairs.speed_m_s(np.abs(np.asarray(velocity_rad_s, dtype=np.float64)))

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        """Joint positions that bring a frame to a pose in the robot's base frame.

        Raises:
            GeometryError: No such frame, out of reach, or only by coming too near to something.
        """
        if frame not in self._frames:
            raise GeometryError(f"no frame '{frame[:80]}'; there are: {', '.join(self._frames)}")
        if not all(map(math.isfinite, pose)):
            raise GeometryError("a pose must be made of finite numbers")
        world = self._in_world(pose)
        tight: Clearance | None = None
        for found in self._solver.solutions(frame, world, starts=(np.asarray(start_rad, dtype=np.float64), self._home)):
            clearance = self.clearance(found.tolist())
            if clearance.room_m >= 0:
                return tuple(found.tolist())
            tight = clearance
        if tight is not None:
            raise GeometryError(f"{frame} cannot go there: {tight.text} would be too near")
        miss_m, miss_rad = self._solver.missed
        raise GeometryError(
            f"found no way to bring {frame} there: the nearest it comes is {miss_m * 1000:.0f} mm and "
            f"{math.degrees(miss_rad):.0f} degrees away"
        )

    # ------------------------------------------------------------ positions and names

    def _place(self, position_rad: Sequence[float] | Floats) -> None:
        self._data.qpos[self._qpos] = position_rad
        self._ties.settle(self._data.qpos)
        mujoco.mj_kinematics(self._model, self._data)

    def _pose(self, is_site: bool, index: int) -> Pose:
        data = self._data
        back = data.xmat[self._base].reshape(3, 3).T
        position = data.site_xpos[index] if is_site else data.xpos[index]
        matrix = (data.site_xmat[index] if is_site else data.xmat[index]).reshape(3, 3)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, (back @ matrix).ravel())
        x, y, z = (back @ (position - data.xpos[self._base])).tolist()
        # A rotation has two quaternions; give the one with w >= 0.
        w, i, j, k = (quaternion if quaternion[0] >= 0 else -quaternion).tolist()
        return (x, y, z, w, i, j, k)

    def _in_world(self, pose: Pose) -> tuple[Floats, Floats]:
        """Position and unit quaternion in the world."""
        size = math.hypot(*pose[3:])
        if size <= 0:
            raise GeometryError("a quaternion must not be all zeros")
        with self._lock:
            base_position, base_quaternion = self._data.xpos[self._base].copy(), self._data.xquat[self._base].copy()
        position, quaternion = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(position, np.array(pose[:3]), base_quaternion)
        mujoco.mju_mulQuat(quaternion, base_quaternion, np.array(pose[3:]) / size)
        return position + base_position, quaternion

    def _frame(self, name: str) -> tuple[bool, int]:
        site = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_SITE, name)
        if site >= 0:
            return True, int(site)
        return False, self._find(mujoco.mjtObj.mjOBJ_BODY, "site or body", name)

    def _find(self, kind: Any, word: str, name: str) -> int:
        index = int(mujoco.mj_name2id(self._model, kind, name))
        if index < 0:
            raise GeometryError(f"the model of '{self._type.type}' has no {word} '{name}'")
        return index


def _spec(scene: Path, standing: Standing | None) -> Any:
    """The robot where it stands; a room is put around it, so that the robot's own names stay as they are."""
    robot = mujoco.MjSpec.from_file(str(scene))
    if standing is None:
        return robot
    room = mujoco.MjSpec.from_file(str(standing.room))
    _agree(room.option, robot.option)
    _agree(room.visual, robot.visual)
    position, quaternion = np.empty(3), np.empty(4)
    half_rad = standing.yaw_rad / 2
    mujoco.mju_negPose(
        position,
        quaternion,
        np.array(standing.position_m),
        np.array((math.cos(half_rad), 0.0, 0.0, math.sin(half_rad))),
    )
    robot.attach(room, prefix=ROOM_PREFIX, frame=robot.worldbody.add_frame(pos=position, quat=quaternion))
    return robot


def _agree(child: Any, parent: Any) -> None:
    """Give one part of a model the options of another: MuJoCo warns, aloud, of each that differs."""
    for name in dir(parent):
        value = getattr(parent, name)
        if name.startswith("_") or callable(value):
            continue
        if isinstance(value, np.ndarray):
            getattr(child, name)[:] = value
        elif isinstance(value, int | float):
            setattr(child, name, value)
        else:
            _agree(getattr(child, name), value)

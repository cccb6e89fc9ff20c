"""Robot geometry in MuJoCo: frame poses, clearance, speed bounds, IK and planning."""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.geometry.base_pose import BasePose
from device_agent.geometry.collision_checker import CollisionChecker
from device_agent.geometry.collision_pairs import ROOM_PREFIX, CollisionPairs
from device_agent.geometry.dependent_joints import DependentJoints
from device_agent.geometry.inverse_kinematics import InverseKinematics
from device_agent.geometry.joint_bounds import JointBounds
from device_agent.geometry.planner_process import PlannerProcess, PlannerScene
from device_agent.geometry.rrt_planner import RrtPlanner
from device_agent.ports.geometry import Clearance, GeometryError, Sweep, never
from device_agent.protocol import Pose
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.equality_joints import EqualityJoints
from device_agent.simulation.mjcf.options import copy_options

Floats = npt.NDArray[np.float64]


class MujocoGeometry:
    """The robot of one type in its scene. Joints without a motor follow the joints that they depend on.

    Distances are between collision shapes (``mj_geomDistance``), which enclose the visible shapes.

    Args:
        robot_type: Joints, frames, workspace, margin.
        scene: MJCF file that contains the robot.
        base_pose: The room and the robot's pose in it.

    Raises:
        GeometryError: The scene cannot be read, lacks a joint or frame of the manifest, or the robot touches something
            in its home position.
    """

    def __init__(self, robot_type: RobotType, scene: Path, *, base_pose: BasePose | None = None) -> None:
        try:
            self._model: Any = _spec(scene, base_pose).compile()
        except (ValueError, OSError, mujoco.FatalError) as error:
            where = scene if base_pose is None else f"{scene} in {base_pose.room}"
            raise GeometryError(f"{where}: MuJoCo cannot build this model: {error}") from error
        self._lock = threading.Lock()
        self._type = robot_type
        self._equality_joints = EqualityJoints(self._model)
        joints = [self._find(mujoco.mjtObj.mjOBJ_JOINT, "joint", joint.name) for joint in robot_type.joints]
        self._qpos = np.array([self._model.jnt_qposadr[joint] for joint in joints], dtype=np.intp)
        self._base = int(self._model.body_rootid[self._model.jnt_bodyid[joints[0]]]) if joints else 0
        self._frames = {name: self._frame(name) for name in robot_type.frames}
        self._home = np.array([robot_type.home_rad[joint.name] for joint in robot_type.joints])
        lower = np.array([joint.lower_rad for joint in robot_type.joints])
        upper = np.array([joint.upper_rad for joint in robot_type.joints])
        self._pairs = CollisionPairs(
            self._model, robot_type, joints, self._frames, base=self._base, equality_joints=self._equality_joints
        )
        self._checker = CollisionChecker(self._model, self._qpos, self._pairs, self._equality_joints, self._home)
        self._pairs.calibrate(self._checker.data, self._checker.place, home=self._home, lower=lower, upper=upper)
        self._checker = CollisionChecker(self._model, self._qpos, self._pairs, self._equality_joints, self._home)
        dependent = DependentJoints(self._model, robot_type, joints, self._equality_joints)
        self._dependent = dependent
        self._ik = InverseKinematics(
            self._model,
            self._qpos,
            self._frames,
            dependent=dependent,
            equality_joints=self._equality_joints,
            lower=lower,
            upper=upper,
        )
        bounds = JointBounds(robot_type)
        self._planner = RrtPlanner(self._model, joints, self._pairs, self._equality_joints, bounds)
        self._planner_process = PlannerProcess(PlannerScene.of(robot_type, scene, base_pose))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames."""
        return tuple(self._frames)

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        """Pose of each frame in the robot's base frame."""
        with self._lock:
            self._checker.place(position_rad)
            return {name: self._pose(is_site, index) for name, (is_site, index) in self._frames.items()}

    def clearance(self, position_rad: Sequence[float]) -> Clearance:
        """The smallest clearance of the robot in one position."""
        with self._lock:
            return self._checker.clearance(position_rad)

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        """Follow straight segments until a pair violates its margin or worsens a violation."""
        with self._lock:
            return self._checker.sweep(path_rad)

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        """Clear share of a straight segment, estimated from a few samples."""
        with self._lock:
            return self._checker.glance(start_rad, end_rad)

    def speed_m_s(self, velocity_rad_s: Sequence[float]) -> float:
        """A speed that no point of the robot exceeds [m/s]."""
        return self._pairs.speed_m_s(np.abs(np.asarray(velocity_rad_s, dtype=np.float64)))

    def rates(
        self, frame: str, twist: Sequence[float], position_rad: Sequence[float], *, tool: bool
    ) -> tuple[float, ...]:
        """Joint velocities that move a frame: least squares, damped near singularities."""
        is_site, index = self._frames[frame]
        with self._lock:
            return self._checker.rates(
                self._base, is_site, index, np.array(twist), position_rad, dependent=self._dependent, tool=tool
            )

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        """Joint positions that bring a frame to a pose in the robot's base frame.

        Raises:
            GeometryError: Unknown frame, pose out of reach, or every solution is too close to something.
        """
        if frame not in self._frames:
            raise GeometryError(f"no frame '{frame[:80]}'; available frames: {', '.join(self._frames)}")
        if not all(map(math.isfinite, pose)):
            raise GeometryError("a pose must consist of finite numbers")
        world = self._in_world(pose)
        blocked: Clearance | None = None
        for solution in self._ik.solutions(frame, world, starts=(np.asarray(start_rad, dtype=np.float64), self._home)):
            clearance = self.clearance(solution.tolist())
            if clearance.excess_m >= 0:
                return tuple(solution.tolist())
            blocked = clearance
        if blocked is not None:
            raise GeometryError(f"{frame} cannot reach this pose: {blocked.text} would be too close")
        miss_m, miss_rad = self._ik.error
        raise GeometryError(
            f"found no joint position for {frame}: the closest one is {miss_m * 1000:.0f} mm and "
            f"{math.degrees(miss_rad):.0f} degrees away"
        )

    def plan(
        self,
        start_rad: Sequence[float],
        goal_rad: Sequence[float],
        *,
        seed: int = 0,
        within_s: float = 5.0,
        ended: Callable[[], bool] = never,
    ) -> tuple[tuple[float, ...], ...]:
        """A collision-free path, planned in a separate process.

        Raises:
            GeometryError: No path was found in time, or the goal is not clear.
            PlannerLostError: The planner process has ended or does not respond.
        """
        return self._planner_process.plan(start_rad, goal_rad, seed=seed, within_s=within_s, ended=ended)

    def plan_here(
        self, start_rad: Sequence[float], goal_rad: Sequence[float], *, seed: int, within_s: float
    ) -> tuple[tuple[float, ...], ...]:
        """Plan in this process, which blocks other threads.

        Raises:
            GeometryError: As for ``plan``.
        """
        return self._planner.plan(start_rad, goal_rad, seed=seed, within_s=within_s)

    # ------------------------------------------------------------ positions and names

    def _pose(self, is_site: bool, index: int) -> Pose:
        data = self._checker.data
        back = data.xmat[self._base].reshape(3, 3).T
        position = data.site_xpos[index] if is_site else data.xpos[index]
        matrix = (data.site_xmat[index] if is_site else data.xmat[index]).reshape(3, 3)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, (back @ matrix).ravel())
        x, y, z = (back @ (position - data.xpos[self._base])).tolist()
        # Of the two quaternions of a rotation return the one with w >= 0.
        w, i, j, k = (quaternion if quaternion[0] >= 0 else -quaternion).tolist()
        return (x, y, z, w, i, j, k)

    def _in_world(self, pose: Pose) -> tuple[Floats, Floats]:
        """Position and unit quaternion in the world."""
        size = math.hypot(*pose[3:])
        if size <= 0:
            raise GeometryError("a quaternion must not be all zeros")
        data = self._checker.data
        with self._lock:
            base_position, base_quaternion = data.xpos[self._base].copy(), data.xquat[self._base].copy()
        position, quaternion = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(position, np.array(pose[:3]), base_quaternion)
        mujoco.mju_mulQuat(quaternion, base_quaternion, np.array(pose[3:]) / size)
        return position + base_position, quaternion

    def _frame(self, name: str) -> tuple[bool, int]:
        site = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_SITE, name)
        if site >= 0:
            return True, int(site)
        return False, self._find(mujoco.mjtObj.mjOBJ_BODY, "site or body", name)

    def _find(self, kind: Any, label: str, name: str) -> int:
        index = int(mujoco.mj_name2id(self._model, kind, name))
        if index < 0:
            raise GeometryError(f"the model of '{self._type.type}' has no {label} '{name}'")
        return index


def _spec(scene: Path, base_pose: BasePose | None) -> Any:
    """The robot's model, with a room around it; the robot's own names stay unchanged."""
    robot = mujoco.MjSpec.from_file(str(scene))
    if base_pose is None:
        return robot
    room = mujoco.MjSpec.from_file(str(base_pose.room))
    copy_options(room.option, robot.option)
    copy_options(room.visual, robot.visual)
    position, quaternion = np.empty(3), np.empty(4)
    half_rad = base_pose.yaw_rad / 2
    mujoco.mju_negPose(
        position,
        quaternion,
        np.array(base_pose.position_m),
        np.array((math.cos(half_rad), 0.0, 0.0, math.sin(half_rad))),
    )
    robot.attach(room, prefix=ROOM_PREFIX, frame=robot.worldbody.add_frame(pos=position, quat=quaternion))
    return robot

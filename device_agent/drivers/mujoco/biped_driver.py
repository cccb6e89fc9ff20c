"""Robots on two legs: an assisted walk.

The walk is simplified in two ways. While it lasts, the gait moves the legs and the agent's leg commands wait. A spring
keeps the torso upright and on course, limited by the manifest (``[simulation.walk]``); the legs carry the weight. At
all other times there is no support: a robot that loses its balance falls. After a
delay it is reset to its start, as an operator would do in a real room.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.drivers.mujoco.gait import FloorPose, Gait, Leg, Legs, Point, make_legs
from device_agent.ports.driver import REST, DriverError, Twist
from device_agent.protocol.manifests.capabilities import Walk
from device_agent.protocol.manifests.robot_type import Base, RobotType
from device_agent.simulation.snapshot import Floats, Ints, Snapshot
from device_agent.simulation.world import World

ODOMETRY = "odometry"

_STIFFNESS_N_M, _DAMPING_NS_M = 1500.0, 60.0
_STIFFNESS_NM, _DAMPING_NMS = 80.0, 4.0
"""Parameters of the torso spring, for a robot of 5 kg; the manifest limits its force."""
_FADE_S = 0.3
"""Time for the transition of the legs from the agent to the gait."""
_SILENT_S = 0.3
"""The robot stops when it has received no twist for this time."""
_STANDING_RAD = 0.15
"""A walk starts only if all leg joints are commanded within this distance from home."""
_CATCH_UP_RAD_S = 1.0
"""Speed at which the legs return to the agent's command after a walk."""
_STILL = 1e-4
"""A smaller twist [m/s, rad/s] counts as zero."""
_RESET_AFTER_S = 10.0
"""Simulated time until a fallen robot is reset."""
_UPRIGHT = 0.8
"""Cosine of the torso's tilt; below it the robot has fallen and cannot walk."""


class _WalkCommand(NamedTuple):
    """The commanded twist and its simulated time [s]."""

    twist: Twist
    at_s: float


class AssistedWalk:
    """``Process`` that walks one robot: moves its legs, supports its torso, and resets it after a fall.

    Args:
        walk: From the manifest.
        model: ``MjModel``.
        base: The robot's root body, on a free joint.
        soles: Sites of the left and the right sole.
        servos: Index of each actuator → index of its joint in ``qpos``.
        actuators: Of both legs, left first, shape (12,).
        legs: Dimensions of both legs.
        gait: The gait.
        height_m: Height of the torso's origin above the soles [m].

    Attributes:
        busy: Whether the gait moves the legs.
        walked: Odometry: pose relative to the start by the gait's steps; slip is not included.
        velocity: Estimated twist.
    """

    def __init__(
        self,
        walk: Walk,
        model: Any,
        *,
        base: int,
        soles: Sequence[int],
        servos: Mapping[int, int],
        actuators: Ints,
        legs: Legs,
        gait: Gait,
        height_m: float,
    ) -> None:
        self._walk = walk
        self._base = base
        self._free = int(model.body_dofadr[base])
        self._free_qpos = int(model.jnt_qposadr[model.body_jntadr[base]])
        self._soles = list(soles)
        self._servos = dict(servos)
        self._fell_s: float | None = None
        self._actuators = actuators
        self._legs = legs
        self._gait = gait
        self._height_m = height_m
        self._command = _WalkCommand(REST, -math.inf)
        self._began_s = 0.0
        self._from: Floats = np.zeros(len(actuators))
        self._data: Any = None
        self._last_s = 0.0
        self._start_poses: tuple[FloorPose, FloorPose] | None = None  # start of the walk: true pose and odometry
        self.busy = False
        self.walked = FloorPose(0.0, 0.0, 0.0)
        self.velocity = REST

    def set_twist(self, twist: Twist, now_s: float) -> None:
        """Set the twist at this simulated time [s]."""
        self._command = _WalkCommand(twist, now_s)

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Advance by one group of steps."""
        elapsed_s, self._last_s = time_s - self._last_s, time_s
        if data is not self._data:  # the world has been reset
            self._data, self.busy, self._gait.walking = data, False, False
            return
        self._reset_if_fallen(model, data, time_s)
        command = self._command
        twist = command.twist if time_s - command.at_s <= _SILENT_S else REST
        if self.busy and (not self._gait.walking or upright(data.xquat[self._base]) < _UPRIGHT):
            self._stop(data)
        if not self.busy:
            if twist == REST or upright(data.xquat[self._base]) < _UPRIGHT:
                return
            self._start(data, twist, time_s)
        self.velocity = twist
        self._gait.advance(elapsed_s, twist)
        share = min(1.0, (time_s - self._began_s) / _FADE_S)
        self._move_legs(data, share)
        self._support_torso(data, share)
        self._update_odometry()

    def _reset_if_fallen(self, model: Any, data: Any, time_s: float) -> None:
        """Reset the robot to its start, with its joints as commanded, when it has lain long enough."""
        if upright(data.xquat[self._base]) >= _UPRIGHT:
            self._fell_s = None
        elif self._fell_s is None:
            self._fell_s = time_s
        elif time_s - self._fell_s >= _RESET_AFTER_S:
            self._fell_s, self.walked = None, FloorPose(0.0, 0.0, 0.0)
            at = self._free_qpos
            data.qpos[at : at + 7] = model.qpos0[at : at + 7]
            data.qvel[self._free : self._free + 6 + len(self._servos)] = 0.0
            for actuator, joint in self._servos.items():
                data.qpos[joint] = data.ctrl[actuator]
            mujoco.mj_kinematics(model, data)
            floor_m = float(model.qpos0[at + 2]) - self._height_m
            data.qpos[at + 2] += floor_m - float(data.site_xpos[self._soles][:, 2].min())
            mujoco.mj_kinematics(model, data)

    def _start(self, data: Any, twist: Twist, time_s: float) -> None:
        x, y = data.xpos[self._base][:2].tolist()
        course = FloorPose(x, y, heading(data.xquat[self._base]))
        self._start_poses = course, self.walked
        self._began_s, self._from = time_s, data.ctrl[self._actuators].copy()
        self._gait.start(course, twist)
        self.busy = True

    def _stop(self, data: Any) -> None:
        data.xfrc_applied[self._base] = 0.0
        self.busy, self._gait.walking, self.velocity = False, False, REST

    def _move_legs(self, data: Any, share: float) -> None:
        soles = self._gait.soles(self._height_m)
        target = np.array(self._legs.positions(soles, self._gait.toes_out_rad))
        data.ctrl[self._actuators] = self._from + (target - self._from) * share

    def _support_torso(self, data: Any, share: float) -> None:
        """Apply the spring's force and torque to the torso, within their limits."""
        place, velocity = self._gait.torso, self._gait.velocity
        x, y, _ = data.xpos[self._base].tolist()
        c, s = math.cos(place.yaw_rad), math.sin(place.yaw_rad)
        vx, vy = data.qvel[self._free : self._free + 2].tolist()
        force = np.array(
            (
                _STIFFNESS_N_M * (place.x_m - x)
                + _DAMPING_NS_M * (c * velocity.forward_m_s - s * velocity.left_m_s - vx),
                _STIFFNESS_N_M * (place.y_m - y)
                + _DAMPING_NS_M * (s * velocity.forward_m_s + c * velocity.left_m_s - vy),
                0.0,
            )
        )
        upright = np.array((math.cos(place.yaw_rad / 2), 0.0, 0.0, math.sin(place.yaw_rad / 2)))
        turn, spin = np.empty(3), np.empty(3)
        mujoco.mju_subQuat(turn, upright, data.xquat[self._base])  # in the torso's frame, like its angular velocity
        torque = _STIFFNESS_NM * turn - _DAMPING_NMS * data.qvel[self._free + 3 : self._free + 6]
        mujoco.mju_rotVecQuat(spin, torque, data.xquat[self._base])
        spin[2] += _DAMPING_NMS * velocity.turn_rad_s
        pull = data.xfrc_applied[self._base]
        pull[:3] = share * _limited(force, self._walk.support_n)
        pull[3:] = share * _limited(spin, self._walk.support_nm)

    def _update_odometry(self) -> None:
        if self._start_poses is not None:
            start, estimate = self._start_poses
            moved = self._gait.course.relative_to(start)
            pose = estimate.shifted(moved.x_m, moved.y_m)
            self.walked = FloorPose(pose.x_m, pose.y_m, math.remainder(estimate.yaw_rad + moved.yaw_rad, 2 * math.pi))


class BipedDriver(MujocoDriver):
    """A ``MobileDriver`` for robot types with ``[simulation.walk]``. The robot walks only from its home posture.

    During a walk the gait commands the legs, and ``send`` returns the gait's leg positions, so telemetry shows the leg
    commands as limited by the driver. At the end of a walk the torso stops immediately and the feet move together. Then
    the legs move slowly to the agent's newest command.
    """

    def __init__(self, *, robot_type: RobotType, world: World, device: str, prefix: str = "", **options: Any) -> None:
        super().__init__(robot_type=robot_type, world=world, device=device, prefix=prefix, **options)
        if robot_type.base is None or robot_type.simulation is None or robot_type.simulation.walk is None:
            raise DriverError(f"robot type '{robot_type.type}' has no [base] or no [simulation.walk]; it cannot walk")
        self._limits: Base = robot_type.base
        self._walk: Walk = robot_type.simulation.walk
        names = [joint.name for joint in robot_type.joints]
        self._leg_joints = np.array(
            [names.index(name) for name in (*self._walk.left, *self._walk.right)], dtype=np.intp
        )
        self._others = np.array([index for index in range(len(names)) if index not in self._leg_joints], dtype=np.intp)
        self._home = np.array([robot_type.home_rad[name] for name in names])[self._leg_joints]
        self._walker: AssistedWalk | None = None
        self._start = FloorPose(0.0, 0.0, 0.0)
        self._legs_at: Floats | None = None  # leg command while the legs catch up

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """As in ``MujocoDriver``; during a walk the returned leg positions are those of the gait.

        Raises:
            DriverError: As for ``MujocoDriver.send``.
        """
        snapshot, walker = self._live(), self._walking()
        if walker.busy:
            applied = self._checked(position_rad)
            self._legs_at = snapshot.ctrl[self._actuators[self._leg_joints]]
            applied[self._leg_joints] = self._legs_at
            others = self._others
            self._world.command(self._device, self._actuators[others], applied[others], ramp_s=self._ramp_s)
            return tuple(applied.tolist())
        if self._legs_at is None:
            return super().send(position_rad)
        target = self._checked(position_rad)
        step_rad = _CATCH_UP_RAD_S * self._type.period_ms / 1000
        distance = target[self._leg_joints] - self._legs_at
        self._legs_at = (
            None if np.abs(distance).max() <= step_rad else self._legs_at + np.clip(distance, -step_rad, step_rad)
        )
        if self._legs_at is not None:
            target[self._leg_joints] = self._legs_at
        return super().send(target.tolist())

    def drive(self, twist: Twist) -> Twist:
        """Walk with this twist for the next period.

        Returns:
            The twist within the base's limits; zero if the robot is not in its home posture.

        Raises:
            DriverError: A value is not finite, not connected, or the simulation has stopped.
        """
        snapshot, walker = self._driven(twist), self._walking()
        fastest, sideways = self._limits.max_linear_m_s, self._limits.max_linear_m_s * self._limits.sideways
        turning = self._limits.max_angular_rad_s
        applied = Twist(
            min(max(twist.forward_m_s, -fastest), fastest),
            min(max(twist.left_m_s, -sideways), sideways),
            min(max(twist.turn_rad_s, -turning), turning),
        )
        if max(map(abs, applied)) < _STILL or not (walker.busy or self._is_in_home_posture(snapshot)):
            applied = REST
        walker.set_twist(applied, snapshot.time_s)
        return applied

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``odometry``: the pose by the robot's steps, and the streams of ``MujocoDriver``.

        Raises:
            DriverError: Not connected.
        """
        if stream != ODOMETRY:
            return super().report(stream)
        self._require()
        walker = self._walking()
        place = self._start.shifted(walker.walked.x_m, walker.walked.y_m)
        yaw_rad = math.remainder(place.yaw_rad + walker.walked.yaw_rad, 2 * math.pi)
        values = {"x_m": place.x_m, "y_m": place.y_m, "yaw_rad": yaw_rad, **walker.velocity._asdict()}
        return {name: round(value, 4) for name, value in values.items()}

    def halt(self) -> None:
        """See ``MujocoDriver``; also stops a walk: the feet move together, and the legs hold."""
        self._halted = True
        if self._walker is not None:
            self._walker.set_twist(REST, 0.0)
        if self._walker is None or not self._walker.busy:
            super().halt()

    def close(self) -> None:
        """See ``MujocoDriver``; also stops a walk."""
        if self._walker is not None:
            self._walker.set_twist(REST, 0.0)
        super().close()

    def _walking(self) -> AssistedWalk:
        if self._walker is None:
            raise DriverError(f"'{self._device}' is not connected")
        return self._walker

    def _is_in_home_posture(self, snapshot: Snapshot) -> bool:
        commanded = snapshot.ctrl[self._actuators[self._leg_joints]]
        upright_now = upright(snapshot.body_quaternion[self._base]) >= _UPRIGHT
        return upright_now and bool(np.abs(commanded - self._home).max() <= _STANDING_RAD)

    # ------------------------------------------------------------ names and dimensions

    def _resolve(self, model: Any) -> None:
        super()._resolve(model)
        if self._walker is not None:
            return
        if model.body_jntnum[self._base] != 1 or model.jnt_type[model.body_jntadr[self._base]] != int(
            mujoco.mjtJoint.mjJNT_FREE
        ):
            raise DriverError(f"the base of '{self._type.type}' has no free joint; it cannot walk")
        data = mujoco.MjData(model)
        free = int(model.jnt_qposadr[model.body_jntadr[self._base]])
        x, y = data.qpos[free : free + 2].tolist()
        self._start = FloorPose(x, y, heading(data.qpos[free + 3 : free + 7]))
        data.qpos[free : free + 7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        mujoco.mj_kinematics(model, data)
        left, right = (
            self._measure(model, data, names, sole)
            for names, sole in zip((self._walk.left, self._walk.right), self._walk.soles, strict=True)
        )
        data.qpos[self._qpos[self._leg_joints]] = self._home
        mujoco.mj_kinematics(model, data)
        feet = [data.site_xpos[self._site(model, sole)].tolist() for sole in self._walk.soles]
        self._walker = AssistedWalk(
            self._walk,
            model,
            base=self._base,
            soles=[self._site(model, sole) for sole in self._walk.soles],
            servos=dict(zip(self._actuators.tolist(), self._qpos.tolist(), strict=True)),
            actuators=self._actuators[self._leg_joints],
            legs=make_legs(left, right, (feet[0][0], feet[0][1], feet[0][2])),
            gait=Gait(
                neutral=((feet[0][0], feet[0][1]), (feet[1][0], feet[1][1])),
                step_s=self._walk.step_s,
                lift_m=self._walk.lift_m,
            ),
            height_m=-(feet[0][2] + feet[1][2]) / 2,
        )
        self._world.add(self._walker)

    def _measure(self, model: Any, data: Any, names: Sequence[str], sole: str) -> Leg:
        """Dimensions of one leg, from the model with all joints at 0."""
        kind = mujoco.mjtObj.mjOBJ_JOINT
        joints = [self._find(model, kind, "joint", model.njnt, name) for name in names]
        bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
        hip, knee, ankle = (data.xpos[bodies[index]] for index in (2, 3, 5))
        axis = model.jnt_axis[joints[0]] / np.linalg.norm(model.jnt_axis[joints[0]])
        return Leg(
            hip_m=_point(hip),
            axis=_point(axis),
            thigh_m=float(np.linalg.norm(knee - hip)),
            shank_m=float(np.linalg.norm(ankle - knee)),
            ankle_m=float(ankle[2] - data.site_xpos[self._site(model, sole)][2]),
        )

    def _site(self, model: Any, name: str) -> int:
        return self._find(model, mujoco.mjtObj.mjOBJ_SITE, "site", model.nsite, name)


def heading(quaternion: Floats) -> float:
    """Direction of the x axis in the horizontal plane [rad]."""
    w, x, y, z = quaternion.tolist()
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def upright(quaternion: Floats) -> float:
    """Cosine of the angle between the z axis and the vertical."""
    _, x, y, _ = quaternion.tolist()
    return float(1.0 - 2.0 * (x * x + y * y))


def _point(vector: Floats) -> Point:
    x, y, z = vector.tolist()
    return x, y, z


def _limited(vector: Floats, size: float) -> Floats:
    now = float(np.linalg.norm(vector))
    return vector if now <= size else vector * (size / now)

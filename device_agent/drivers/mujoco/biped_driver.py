"""Robots on two legs: an assisted walk.

While it walks, two things are not as on real metal. The legs are the gait's, a script: what the agent commands for them
waits. And the torso is helped, by a spring that holds it upright and draws it along the course, no harder than the
manifest says (``[simulation.walk]``); nothing carries its weight but the legs. Standing, sitting and all that the
agent's own commands do has no help: a robot that loses its balance falls. It then lies, until it is carried back to
where it began, as a person in a real room would.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from device_agent.drivers.mujoco.driver import MujocoDriver
from device_agent.drivers.mujoco.gait import Gait, Leg, Legs, Place, Point, legs
from device_agent.ports.driver import REST, DriverError, Twist
from device_agent.protocol.manifests.capabilities import Walk
from device_agent.protocol.manifests.robot_type import Base, RobotType
from device_agent.simulation.snapshot import Floats, Ints, Snapshot
from device_agent.simulation.world import World

ODOMETRY = "odometry"

_STIFFNESS_N_M, _DAMPING_NS_M = 1500.0, 60.0
_STIFFNESS_NM, _DAMPING_NMS = 80.0, 4.0
"""Of the spring that helps the torso: firm for five kilograms. What counts is how hard it may pull."""
_FADE_S = 0.3
"""Time in which legs and help pass from the agent to the gait."""
_SILENT_S = 0.3
"""A robot that nobody has told to walk for so long stops."""
_STANDING_RAD = 0.15
"""As near to home all joints of the legs must be commanded for a walk to begin."""
_CATCH_UP_RAD_S = 1.0
"""How fast the legs go to where the agent has commanded them meanwhile, after a walk."""
_STILL = 1e-4
"""A twist of less [m/s, rad/s] is none: nobody makes steps for it."""
_LIES_S = 10.0
"""Simulated time that it lies until somebody comes."""
_UPRIGHT = 0.8
"""Cosine of the torso's tilt: less is a fall, and nobody walks lying."""


class _Order(NamedTuple):
    """How to walk, and when that was said, in simulated time [s]."""

    twist: Twist
    said_s: float


class Walker:
    """``Process`` that moves one robot's legs while it walks, helps its torso, and carries it back when it has fallen.

    Args:
        walk: From the manifest.
        model: ``MjModel``.
        base: The robot's root body, on a free joint.
        soles: Sites of the left and the right sole.
        servos: Index of each of its actuators → where its joint is in ``qpos``.
        actuators: Of both legs, the left one's first, shape (12,).
        measures: Both legs.
        gait: How it steps.
        height_m: Of the torso's origin above the soles [m].

    Attributes:
        busy: Whether the legs are the gait's.
        walked: Where the gait believes to have gone since the beginning, by its own steps; slipping is not seen.
        velocity: How fast it believes to go.
    """

    def __init__(
        self,
        walk: Walk,
        model: Any,
        *,
        base: int,
        soles: tuple[int, int],
        servos: Mapping[int, int],
        actuators: Ints,
        measures: Legs,
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
        self._legs = measures
        self._gait = gait
        self._height_m = height_m
        self._order = _Order(REST, -math.inf)
        self._began_s = 0.0
        self._from: Floats = np.zeros(len(actuators))
        self._data: Any = None
        self._last_s = 0.0
        self._own: tuple[Place, Place] | None = None  # where the course began, in the world and as believed
        self.busy = False
        self.walked = Place(0.0, 0.0, 0.0)
        self.velocity = REST

    def tell(self, twist: Twist, now_s: float) -> None:
        """How to walk from now on [simulated s]."""
        self._order = _Order(twist, now_s)

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """One group of steps further."""
        elapsed_s, self._last_s = time_s - self._last_s, time_s
        if data is not self._data:  # a world that began anew
            self._data, self.busy, self._gait.walking = data, False, False
            return
        self._look_after(model, data, time_s)
        order = self._order
        twist = order.twist if time_s - order.said_s <= _SILENT_S else REST
        if self.busy and (not self._gait.walking or upright(data.xquat[self._base]) < _UPRIGHT):
            self._end(data)
        if not self.busy:
            if twist == REST or upright(data.xquat[self._base]) < _UPRIGHT:
                return
            self._begin(data, twist, time_s)
        self.velocity = twist
        self._gait.advance(elapsed_s, twist)
        share = min(1.0, (time_s - self._began_s) / _FADE_S)
        self._move_legs(data, share)
        self._help(data, share)
        self._believe()

    def _look_after(self, model: Any, data: Any, time_s: float) -> None:
        """Stand it where it began, joints as commanded, when it has lain for a while."""
        if upright(data.xquat[self._base]) >= _UPRIGHT:
            self._fell_s = None
        elif self._fell_s is None:
            self._fell_s = time_s
        elif time_s - self._fell_s >= _LIES_S:
            self._fell_s, self.walked = None, Place(0.0, 0.0, 0.0)
            at = self._free_qpos
            data.qpos[at : at + 7] = model.qpos0[at : at + 7]
            data.qvel[self._free : self._free + 6 + len(self._servos)] = 0.0
            for actuator, joint in self._servos.items():
                data.qpos[joint] = data.ctrl[actuator]
            mujoco.mj_kinematics(model, data)
            floor_m = float(model.qpos0[at + 2]) - self._height_m
            data.qpos[at + 2] += floor_m - float(data.site_xpos[self._soles][:, 2].min())
            mujoco.mj_kinematics(model, data)

    def _begin(self, data: Any, twist: Twist, time_s: float) -> None:
        x, y = data.xpos[self._base][:2].tolist()
        course = Place(x, y, heading(data.xquat[self._base]))
        self._own = course, self.walked
        self._began_s, self._from = time_s, data.ctrl[self._actuators].copy()
        self._gait.begin(course, twist)
        self.busy = True

    def _end(self, data: Any) -> None:
        data.xfrc_applied[self._base] = 0.0
        self.busy, self._gait.walking, self.velocity = False, False, REST

    def _move_legs(self, data: Any, share: float) -> None:
        soles = self._gait.soles(self._height_m)
        target = np.array(self._legs.positions(soles, self._gait.toes_out_rad))
        data.ctrl[self._actuators] = self._from + (target - self._from) * share

    def _help(self, data: Any, share: float) -> None:
        """The spring's pull on the torso, up to what it may."""
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
        wanted = np.array((math.cos(place.yaw_rad / 2), 0.0, 0.0, math.sin(place.yaw_rad / 2)))
        turn, spin = np.empty(3), np.empty(3)
        mujoco.mju_subQuat(turn, wanted, data.xquat[self._base])  # in the torso's frame, as its own spin is
        torque_here = _STIFFNESS_NM * turn - _DAMPING_NMS * data.qvel[self._free + 3 : self._free + 6]
        mujoco.mju_rotVecQuat(spin, torque_here, data.xquat[self._base])
        spin[2] += _DAMPING_NMS * velocity.turn_rad_s
        pull = data.xfrc_applied[self._base]
        pull[:3] = share * _at_most(force, self._walk.support_n)
        pull[3:] = share * _at_most(spin, self._walk.support_nm)

    def _believe(self) -> None:
        if self._own is not None:
            began, believed = self._own
            gone = self._gait.course.seen_from(began)
            there = believed.beside(gone.x_m, gone.y_m)
            self.walked = Place(there.x_m, there.y_m, math.remainder(believed.yaw_rad + gone.yaw_rad, 2 * math.pi))


class WalkingDriver(MujocoDriver):
    """A ``MobileDriver`` for robot types with ``[simulation.walk]``. Its robot walks from home, and nowhere else from.

    Who commands the legs is decided here: the agent, except from the first step of a walk to the last. What ``send``
    then returns for them is what the gait does, so telemetry shows them as limited by the driver. A walk that is told
    to end stops the torso at once, puts down the foot that is in the air and brings the other one beside it; the legs
    are then where they were before, and go only slowly to where the agent has commanded them meanwhile.
    """

    def __init__(self, *, robot_type: RobotType, world: World, device: str, prefix: str = "", **more: Any) -> None:
        super().__init__(robot_type=robot_type, world=world, device=device, prefix=prefix, **more)
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
        self._walker: Walker | None = None
        self._start = Place(0.0, 0.0, 0.0)
        self._legs_at: Floats | None = None  # where the legs were commanded when a walk ended, while they catch up

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """As of every driver; while it walks, the legs are not commanded, and read as what the gait does.

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
        asked = self._checked(position_rad)
        most = _CATCH_UP_RAD_S * self._type.period_ms / 1000
        way = asked[self._leg_joints] - self._legs_at
        self._legs_at = None if np.abs(way).max() <= most else self._legs_at + np.clip(way, -most, most)
        if self._legs_at is not None:
            asked[self._leg_joints] = self._legs_at
        return super().send(asked.tolist())

    def drive(self, twist: Twist) -> Twist:
        """Walk so for the next period.

        Returns:
            The twist, inside the base's limits; no motion at all where the robot does not stand as at home.

        Raises:
            DriverError: A number is not finite, not connected, or the simulation has stopped.
        """
        snapshot, walker = self._live(), self._walking()
        if not all(map(math.isfinite, twist)):
            raise DriverError("a commanded twist is not finite")
        fastest, sideways = self._limits.max_linear_m_s, self._limits.max_linear_m_s * self._limits.sideways
        turning = self._limits.max_angular_rad_s
        applied = Twist(
            min(max(twist.forward_m_s, -fastest), fastest),
            min(max(twist.left_m_s, -sideways), sideways),
            min(max(twist.turn_rad_s, -turning), turning),
        )
        if max(map(abs, applied)) < _STILL or not (walker.busy or self._stands(snapshot)):
            applied = REST
        walker.tell(applied, snapshot.time_s)
        return applied

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``odometry``: where the steps say that it is, from where it was put; and what every simulated robot tells.

        Raises:
            DriverError: Not connected.
        """
        if stream != ODOMETRY:
            return super().report(stream)
        self._require()
        walker = self._walking()
        place = self._start.beside(walker.walked.x_m, walker.walked.y_m)
        return {
            "x_m": round(place.x_m, 4),
            "y_m": round(place.y_m, 4),
            "yaw_rad": round(math.remainder(place.yaw_rad + walker.walked.yaw_rad, 2 * math.pi), 4),
            "forward_m_s": round(walker.velocity.forward_m_s, 4),
            "left_m_s": round(walker.velocity.left_m_s, 4),
            "turn_rad_s": round(walker.velocity.turn_rad_s, 4),
        }

    def close(self) -> None:
        """See ``MujocoDriver``; what still walks stops."""
        if self._walker is not None:
            self._walker.tell(REST, 0.0)
        super().close()

    def _walking(self) -> Walker:
        if self._walker is None:
            raise DriverError(f"'{self._device}' is not connected")
        return self._walker

    def _stands(self, snapshot: Snapshot) -> bool:
        commanded = snapshot.ctrl[self._actuators[self._leg_joints]]
        upright_now = upright(snapshot.body_quaternion[self._base]) >= _UPRIGHT
        return upright_now and bool(np.abs(commanded - self._home).max() <= _STANDING_RAD)

    # ------------------------------------------------------------ names and measures

    def _resolve(self, model: Any) -> None:
        super()._resolve(model)
        if self._walker is not None:
            return
        if model.body_jntnum[self._base] != 1 or model.jnt_type[model.body_jntadr[self._base]] != int(
            mujoco.mjtJoint.mjJNT_FREE
        ):
            raise DriverError(f"the base of '{self._type.type}' has no free joint; it cannot walk")
        data = mujoco.MjData(model)
        self._start = _place(data.qpos[int(model.jnt_qposadr[model.body_jntadr[self._base]]) :])
        free = int(model.jnt_qposadr[model.body_jntadr[self._base]])
        data.qpos[free : free + 7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        mujoco.mj_kinematics(model, data)
        left, right = (
            self._measure(model, data, names, sole)
            for names, sole in zip((self._walk.left, self._walk.right), self._walk.soles, strict=True)
        )
        data.qpos[self._qpos[self._leg_joints]] = self._home
        mujoco.mj_kinematics(model, data)
        feet = [data.site_xpos[self._site(model, sole)].tolist() for sole in self._walk.soles]
        self._walker = Walker(
            self._walk,
            model,
            base=self._base,
            soles=(self._site(model, self._walk.soles[0]), self._site(model, self._walk.soles[1])),
            servos=dict(zip(self._actuators.tolist(), self._qpos.tolist(), strict=True)),
            actuators=self._actuators[self._leg_joints],
            measures=legs(left, right, (feet[0][0], feet[0][1], feet[0][2])),
            gait=Gait(
                neutral=((feet[0][0], feet[0][1]), (feet[1][0], feet[1][1])),
                step_s=self._walk.step_s,
                lift_m=self._walk.lift_m,
            ),
            height_m=-(feet[0][2] + feet[1][2]) / 2,
        )
        self._world.add(self._walker)

    def _measure(self, model: Any, data: Any, names: Sequence[str], sole: str) -> Leg:
        """One leg's measures, from the model with all joints at zero."""
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
    """Where the x axis points, seen from above [rad]."""
    w, x, y, z = quaternion.tolist()
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def upright(quaternion: Floats) -> float:
    """Cosine of the angle between the z axis and the vertical."""
    _, x, y, _ = quaternion.tolist()
    return float(1.0 - 2.0 * (x * x + y * y))


def _place(free_joint: Floats) -> Place:
    return Place(float(free_joint[0]), float(free_joint[1]), heading(free_joint[3:7]))


def _point(vector: Floats) -> Point:
    x, y, z = vector.tolist()
    return x, y, z


def _at_most(vector: Floats, size: float) -> Floats:
    now = float(np.linalg.norm(vector))
    return vector if now <= size else vector * (size / now)

"""What a script's calls reach on its own device, for as long as its action has it."""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from device_agent.ports import skills
from device_agent.ports.driver import Observation, Twist
from device_agent.ports.geometry import Geometry, GeometryError
from device_agent.ports.skills import Skill, SkillError, Skills
from device_agent.protocol.messages import Quaternion, Vector3
from device_agent.protocol.robot_type import RobotType
from device_agent.runtime import calls, gaze, shows
from device_agent.runtime.authority import Tenure
from device_agent.runtime.controller import Controller
from device_agent.runtime.courses import Course, Outcome
from device_agent.runtime.instrument import Instrument
from device_agent.runtime.lease import Refused
from device_agent.runtime.room import Reading, Room

CARTESIAN = "cartesian"
"""A capability that a manifest may name, besides those of ``ports.skills``."""
_SHORTEST = 1e-6


@dataclass(frozen=True, slots=True)
class Body:
    """A device as its scripts meet it.

    Attributes:
        robot_type: Joints, frames, capabilities, home.
        controller: What moves it.
        observe: The newest measurement, or ``None`` before the first.
        geometry: Its shape, where its type has a model.
        skills: What its driver can besides.
        room: What the space's other devices have measured last.
        reported: The newest of each of its own streams besides ``joints``.
        instrument: The device as a room's, where it is one.
    """

    robot_type: RobotType
    controller: Controller
    observe: Callable[[], Observation | None]
    geometry: Geometry | None
    skills: Skills | None
    room: Room
    reported: Callable[[], Mapping[str, Reading]] = dict
    instrument: Instrument | None = None

    def seen(self) -> Observation:
        """The newest measurement.

        Raises:
            Refused: There is none yet.
        """
        seen = self.observe()
        if seen is None:
            raise Refused("no_measurement", "the robot has not been measured yet")
        return seen

    def measured(self) -> dict[str, Any]:
        """Where it is, as results show it; empty before the first measurement, and without joints."""
        seen = self.observe()
        if seen is None or not self.robot_type.joints:
            return {}
        return {"position_rad": by_name(self.robot_type, seen.position_rad)}

    def can(self) -> tuple[str, ...]:
        """Names of the calls that scripts have on this robot."""
        kind, named = self.robot_type, set(self.robot_type.capabilities)
        by_skill = named & set(() if self.skills is None else self.skills.performs)
        has = {
            "move_joints": bool(kind.joints),
            "home": bool(kind.joints),
            "move_to": CARTESIAN in named and self.geometry is not None,
            "drive": kind.base is not None,
            "look": skills.GAZE in by_skill or (kind.gaze is not None and self.geometry is not None),
            "say": skills.SPEECH in by_skill,
            "stiffness": skills.STIFFNESS in by_skill,
            "express": skills.EXPRESSIONS in by_skill or bool(kind.expressions),
            "posture": skills.POSTURES in by_skill or bool(kind.postures),
            "behaviour": skills.BEHAVIOURS in by_skill,
            "state": True,
            "latest": True,
        }
        return tuple(name for name, there in has.items() if there)


class ScriptRobot:
    """``Reach`` of one action.

    Args:
        body: The device.

    Attributes:
        limited: What limited its motion so far, as telemetry names it.
    """

    def __init__(self, body: Body) -> None:
        self._body = body
        self._tenure = Tenure(epoch=-1, on_lost=_nobody)  # of nothing, until ``begin``
        self._over = threading.Event()
        self.joints = tuple(joint.name for joint in body.robot_type.joints)
        self.frames = () if body.geometry is None else tuple(body.geometry.frames)
        self.can = body.can()
        self.limited: tuple[str, ...] = ()

    def begin(self, epoch: int, on_lost: Callable[[Refused], None]) -> None:
        """Take the device. ``on_lost`` is called when somebody takes it away, with the controller locked.

        Raises:
            Refused: It cannot be taken.
        """
        self._tenure = self._body.controller.begin_action(epoch=epoch, on_lost=on_lost)

    def end(self) -> None:
        """The action is over, or has lost the device: no skill goes on. Never blocks."""
        self._over.set()

    def give_back(self) -> None:
        """Leave the device; what still moves is held."""
        self.end()
        self._body.controller.end_action(self._tenure)

    def do(self, call: calls.Call) -> Any:
        """See ``Reach``."""
        kind = str(type(call).__struct_config__.tag)
        if kind not in self.can:
            raise Refused("cannot", f"this robot has no {kind}; it has {', '.join(self.can)}")
        match call:
            case calls.MoveJoints(position_rad=position_rad, speed=speed):
                self.move_joints(position_rad, speed)
            case calls.Home(speed=speed):
                self.move_joints(self._body.robot_type.home_rad, speed)
            case calls.MoveTo():
                self._move_to(call)
            case calls.Drive():
                self._drive(call)
            case calls.Look(position_m=position_m, speed=speed):
                self._look(position_m, speed)
            case calls.AskState():
                return self._state()
            case calls.AskLatest(device=device, stream=stream):
                return self._latest(device, stream)
            case _:
                self._show(call)
        return None

    def _show(self, call: calls.Show) -> None:
        """By what the manifest says, or by what the driver can."""
        kind = self._body.robot_type
        match call:
            case calls.Express(name=name, strength=strength) if self._by_data(skills.EXPRESSIONS):
                _check_share("strength", strength)
                self.move_joints(shows.expression(kind, name, strength), shows.EXPRESSION_SPEED)
            case calls.Posture(name=name, speed=speed) if self._by_data(skills.POSTURES):
                self.move_joints(shows.posture(kind, name), speed)
            case _:
                self._perform(_skill(call))

    def _by_data(self, capability: str) -> bool:
        """Whether the manifest says how; else the driver knows."""
        able = self._body.skills
        return able is None or capability not in self._body.robot_type.capabilities or capability not in able.performs

    def move_joints(self, position_rad: Mapping[str, float], speed: float) -> None:
        """Move and wait until there [rad].

        Raises:
            Refused: It did not get there.
        """
        _check_share("speed", speed, least=math.nextafter(0, 1))
        self._follow(self._body.controller.move(self._tenure, dict(position_rad), speed=speed))

    def _move_to(self, call: calls.MoveTo) -> None:
        geometry, start = self._shape(), self._body.seen().position_rad
        if call.frame not in geometry.frames:
            raise Refused("unknown_frame", f"no frame '{call.frame[:80]}'; there are {', '.join(geometry.frames)}")
        quaternion = call.quaternion
        if call.rpy_rad is not None:
            quaternion = _from_rpy(call.rpy_rad)
        if quaternion is None:
            w, x, y, z = geometry.poses(start)[call.frame][3:]
            quaternion = (w, x, y, z)
        length = math.hypot(*quaternion)
        if not _SHORTEST < length < math.inf:
            raise Refused("bad_quaternion", "the quaternion (w, x, y, z) has no direction")
        w, x, y, z = (part / length for part in quaternion)
        try:
            solved = geometry.solve(call.frame, (*call.position_m, w, x, y, z), start)
        except GeometryError as error:
            raise Refused("out_of_reach", str(error)) from error
        self.move_joints(by_name(self._body.robot_type, solved), call.speed)

    def _drive(self, call: calls.Drive) -> None:
        twist = Twist(call.forward_m_s, call.left_m_s, call.turn_rad_s)
        self._follow(self._body.controller.drive(self._tenure, twist, duration_s=call.duration_s))

    def _follow(self, course: Course) -> None:
        """Wait for its end."""
        course.finished.wait()
        self.limited += tuple(one for one in course.limited if one not in self.limited)
        if course.outcome is not Outcome.REACHED:
            raise course.why or Refused("interrupted", "the move was interrupted")

    def _look(self, position_m: Vector3, speed: float) -> None:
        _check_share("speed", speed, least=math.nextafter(0, 1))
        if self._body.robot_type.gaze is None:
            self._perform(skills.LookAt(position_m, speed))
        else:
            start = self._body.seen().position_rad
            self.move_joints(gaze.aim(self._body.robot_type, self._shape(), start, position_m), speed)

    def _shape(self) -> Geometry:
        if self._body.geometry is None:
            raise Refused("no_model", "this robot's type has no model")
        return self._body.geometry

    def _state(self) -> dict[str, Any]:
        seen, kind = self._body.seen(), self._body.robot_type
        return {
            "position_rad": by_name(kind, seen.position_rad),
            "velocity_rad_s": by_name(kind, seen.velocity_rad_s),
            "effort_nm": by_name(kind, seen.effort_nm),
            "frames": dict(zip(kind.frames, seen.frames, strict=False)),
            "mode": str(self._body.controller.mode),
            "streams": {stream: _shown(reading) for stream, reading in self._body.reported().items()},
        }

    def _latest(self, device: str, stream: str) -> dict[str, Any] | None:
        reading = self._body.room.latest(device, stream)
        return None if reading is None else _shown(reading)

    def _perform(self, skill: Skill) -> None:
        if self._body.skills is None:
            raise Refused("cannot", "this robot's driver has no skills")
        if not self._over.is_set():
            try:
                self._body.skills.perform(skill, _Stage(self, self._over))
            except SkillError as error:
                raise self._tenure.why or Refused("skill_failed", str(error)) from error
        if self._over.is_set():
            raise self._tenure.why or Refused("ended", "the action ended")


class _Stage:
    """``Stage`` of one skill."""

    def __init__(self, robot: ScriptRobot, over: threading.Event) -> None:
        self._robot = robot
        self._over = over

    @property
    def ended(self) -> bool:
        """See ``Stage``."""
        return self._over.is_set()

    def wait(self, timeout_s: float) -> bool:
        """See ``Stage``."""
        return self._over.wait(timeout_s)

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        """See ``Stage``."""
        try:
            self._robot.move_joints(position_rad, speed)
        except Refused as refused:
            raise SkillError(refused.message) from refused


def _skill(call: calls.Show) -> Skill:
    match call:
        case calls.Say(text=text, language=language):
            return skills.Say(text, language)
        case calls.Stiffness(value=value, joints=joints):
            _check_share("stiffness", value)
            return skills.Stiffen(value, joints)
        case calls.Express(name=name, strength=strength):
            _check_share("strength", strength)
            return skills.Express(name, strength)
        case calls.Posture(name=name, speed=speed):
            _check_share("speed", speed, least=math.nextafter(0, 1))
            return skills.Pose(name, speed)
    return skills.Behave(call.name)


def _shown(reading: Reading) -> dict[str, Any]:
    return {"values": dict(reading.values), "age_s": reading.age_s}


def _check_share(name: str, value: float, *, least: float = 0.0) -> None:
    if not least <= value <= 1:  # false for NaN
        raise Refused(f"bad_{name}", f"{name} must be {'above ' if least else ''}0 and at most 1, not {value}")


def _from_rpy(rpy_rad: Vector3) -> Quaternion:
    """Roll, pitch, yaw about the fixed x, y, z [rad]."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle / 2), math.sin(angle / 2)) for angle in rpy_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _nobody(_: Refused) -> None:
    """Nobody is told."""


def by_name(robot_type: RobotType, values: Sequence[float]) -> dict[str, float]:
    """Values in joint order as joint name → value."""
    return dict(zip((joint.name for joint in robot_type.joints), values, strict=True))

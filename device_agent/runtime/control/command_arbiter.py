"""What the motors of one device are told, period by period: whose wish counts now, and when it comes to rest.

When in doubt: hold. Pure but for ``ruckig``: no thread, clock or I/O of its own, so that every path can be tested
tick by tick.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from device_agent.ports.driver import REST, Twist
from device_agent.ports.geometry import Clearance, RobotGeometry
from device_agent.protocol import Mode, StopLatch
from device_agent.protocol.events import EventKind
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.authority.authority import Authority
from device_agent.runtime.authority.event_recorder import Tell
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.goal_executor import GoalExecutor
from device_agent.runtime.control.joint_motion import MotionError
from device_agent.runtime.control.joint_stiffness import JointStiffness
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.control.setpoint_stream import SetpointStream
from device_agent.runtime.errors import Refused

_CREEP_RAD_S = 0.02
"""Slower than this, setpoints that end are a slider let go at its target, not an operator lost in mid-motion."""
_REMEMBERED = 0.998
"""Of how late the control loop was called, from one period to the next: half of it after three seconds."""
_SAME_RAD = 1e-6
_SAME_TWIST = 1e-3


@dataclass(frozen=True, slots=True)
class ControlOutput:
    """What one ``step`` decided. ``position_rad`` and ``twist`` are for the motors; the rest is for telemetry."""

    position_rad: list[float]
    mode: Mode
    epoch: int
    setpoint_sequence: int
    setpoint_sent_ms: float
    loop_age_ms: float
    limited: tuple[str, ...]
    twist: Twist = REST


class CommandArbiter:
    """Follows setpoints or an action's course while whoever asked may move it. Not thread-safe: its owner locks.

    Args:
        robot_type: Joints and limits.
        gate: The lease gate, with the epochs remembered from before.
        latch: The Stop latch remembered from before.
        geometry: The robot's shape; without it nobody knows what it could touch.
        tell: Called with each change of authority.

    Attributes:
        envelope: What positions may be.
        helm: What actions ask.
        stream: What setpoints ask.
        slack: How firmly joints hold.
        authority: Who may ask.
        mode: What the last ``step`` did.
    """

    def __init__(
        self,
        robot_type: RobotType,
        gate: LeaseGate,
        *,
        latch: StopLatch | None,
        geometry: RobotGeometry | None,
        tell: Tell,
    ) -> None:
        self._joints = robot_type.joints
        self._period_s = robot_type.period_ms / 1000
        self.envelope = MotionLimits(robot_type, geometry)
        self.helm = GoalExecutor(robot_type, self.envelope)
        self._motion = self.helm.motion
        self.stream = SetpointStream(robot_type, self.envelope, geometry)
        self.slack = JointStiffness(robot_type)
        self.authority = Authority(gate, latch, hold=self._hold, tell=tell)
        self.mode = Mode.IDLE
        self._due_s = math.inf
        self._late_s = 0.0
        self._driver_limits: tuple[str, ...] = ()
        self._base_limits: tuple[str, ...] = ()

    def step(
        self, now_s: float, measured_rad: Sequence[float] | None = None, *, passed_s: float | None = None
    ) -> ControlOutput:
        """Decide this period's command.

        Args:
            now_s: Monotonic clock [s].
            measured_rad: Where the joints are, shape (n,); limp ones are commanded there, others are to arrive there.
            passed_s: Since the last period began, where a Stop makes this one come early [s].
        """
        if measured_rad is not None:
            self._motion.loosen(self.slack.feel(measured_rad))
        late_s, self._due_s = now_s - self._due_s, now_s + self._period_s
        self._late_s = max(late_s, _REMEMBERED * self._late_s)
        self.authority.expire(now_s)
        self.mode = self._decide(now_s)
        try:
            obstacle = self.helm.look(late_s)
            if obstacle is not None:
                self._block(obstacle)
            self.helm.update(passed_s)
        except MotionError as error:
            self.authority.end(Refused("fault", str(error)))
            self.mode = Mode.HOLDING
            self.helm.give_up()
        limited = self._limits()
        self.helm.settle(limited, measured_rad=measured_rad, soft=self.slack.soft)
        lease = self.authority.lease(now_s)
        return ControlOutput(
            list(self._motion.position_rad),
            self.mode,
            lease.epoch if lease else 0,
            self.stream.taken,
            self.stream.sent_ms,
            self.stream.loop_age_ms,
            limited,
            self.helm.twist,
        )

    def applied(self, position_rad: Sequence[float]) -> None:
        """What the driver made of the last command, shape (n,) [rad]; where it differs, ``limited`` says so."""
        self._driver_limits = tuple(
            f"{joint.name}: driver"
            for joint, asked, done in zip(self._joints, self._motion.position_rad, position_rad, strict=True)
            if abs(asked - done) > _SAME_RAD
        )

    def driven(self, asked: Twist, done: Twist) -> None:
        """What the driver made of the last twist; where it differs, ``limited`` says so: who sits does not walk."""
        differs = any(abs(wanted - applied) > _SAME_TWIST for wanted, applied in zip(asked, done, strict=True))
        self._base_limits = ("base: driver",) if differs else ()

    def _block(self, obstacle: Clearance) -> None:
        course = self.helm.course
        if course is None:
            self.stream.block(obstacle)
            self._motion.brake()
        else:
            course.note((obstacle.text,))
            why = f"something is in the way: {obstacle.text}; the device holds before it"
            self.helm.interrupt(Refused("no_room", why))

    def _decide(self, now_s: float) -> Mode:
        if self.authority.fault is not None:
            self.helm.brake()
            return Mode.FAULT
        if self.authority.latch is not None:
            self.helm.brake()
            return Mode.STOPPED
        if self.authority.restrictions.speed <= 0:
            self.helm.brake()
            return Mode.HOLDING
        if self.authority.tenure is not None:
            self.helm.follow(self.authority.restrictions.speed)
            return Mode.ACTION
        if self.stream.fresh(now_s, self.helm.braking_time_s(), late_s=self._late_s):
            allowed = self.authority.restrictions.speed
            self.stream.follow(self._motion, allowed=allowed)
            if self.helm.base is not None:
                self.stream.steer(self.helm.base, now_s, late_s=self._late_s, allowed=allowed)
            return Mode.STREAMING
        if self.mode is Mode.STREAMING and self.helm.faster_than(_CREEP_RAD_S):
            self.authority.end(Refused("watchdog", "setpoints stopped coming"))
        self.stream.drop()
        self.helm.brake()
        held = self.mode is Mode.HOLDING and (self.helm.moving or self.authority.burned)
        return Mode.HOLDING if held else Mode.IDLE

    def _limits(self) -> tuple[str, ...]:
        """What makes the motion other than asked, for telemetry."""
        strictest = self.authority.restrictions.strictest
        limited: tuple[str, ...] = () if strictest is None else (strictest.text,)
        if self.mode is Mode.STREAMING:
            limited += self.stream.limited
        return limited + self._motion.waits + self.slack.limited + self._driver_limits + self._base_limits

    def _hold(self, why: Refused) -> None:
        """Bring the device to rest; whoever moved it no longer does."""
        self.stream.drop()
        if self.helm.moving:
            if self.mode in {Mode.STREAMING, Mode.ACTION}:  # told once, not for each order to hold while it brakes
                self.authority.note(EventKind.MOTION_HELD, why.message, self.authority.said(why), "warning")
            self.mode = Mode.HOLDING
        self.helm.interrupt(why)
        self.helm.brake()

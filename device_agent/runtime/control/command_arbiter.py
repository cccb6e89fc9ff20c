"""Command arbitration: decides in each period between hold, setpoint and goal.

In doubt the device holds. There is no thread, clock or I/O here, so that each path can be tested period by period.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from device_agent.ports.driver import REST, Twist
from device_agent.ports.geometry import Clearance
from device_agent.protocol import Mode
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.control_state import ControlState
from device_agent.runtime.control.joint_motion import MotionError
from device_agent.runtime.errors import Refused

_CREEP_RAD_S = 0.02
"""If setpoints stop below this speed, an operator released a slider at its target: no watchdog event [rad/s]."""
_DELAY_DECAY = 0.998
"""Factor of the remembered loop delay from one period to the next: it halves in three seconds."""
_SAME_RAD = 1e-6
_SAME_TWIST = 1e-3


@dataclass(frozen=True, slots=True)
class ControlOutput:
    """Output of one period. ``position_rad`` and ``twist`` are motor commands; the rest is for telemetry.

    ``stops``: number of Stops received before this period. ``requested_rad``: target of the source before limits; empty
    if it has no target. ``seen_tick_ms``: tick that the setpoint echoes.
    """

    position_rad: list[float]
    mode: Mode
    epoch: int
    setpoint_sequence: int
    setpoint_sent_ms: float
    loop_age_ms: float
    limited: tuple[str, ...]
    twist: Twist = REST
    stops: int = 0
    ended_input: int = 0
    requested_rad: Sequence[float] = ()
    seen_tick_ms: int = 0


class CommandArbiter:
    """Selects the source of motion in each period. Not thread-safe: the controller locks."""

    def __init__(self, robot_type: RobotType, state: ControlState) -> None:
        self._joints = robot_type.joints
        self._period_s = robot_type.period_ms / 1000
        self._state = state
        self._due_s = math.inf
        self._late_s = 0.0
        self._driver_limits: tuple[str, ...] = ()
        self._base_limits: tuple[str, ...] = ()

    def update(
        self, now_s: float, measured_rad: Sequence[float] | None, elapsed_s: float | None, *, settled: bool
    ) -> ControlOutput:
        """Compute the command of this period; see ``Controller.update``."""
        state = self._state
        if measured_rad is not None:
            state.motion.track_measured(state.stiffness.track(measured_rad))
        late_s, self._due_s = now_s - self._due_s, now_s + self._period_s
        self._late_s = max(late_s, _DELAY_DECAY * self._late_s)
        state.authority.expire(now_s)
        state.mode = self._select_mode(now_s)
        try:
            obstacle = state.goals.check_clearance(late_s)
            if obstacle is not None:
                self._block(obstacle)
            state.goals.update(elapsed_s)
        except MotionError as error:
            state.authority.end(Refused("fault", str(error)))
            state.mode = Mode.HOLDING
            state.goals.abort()
        limited, requested_rad = self._limited(), self._requested()
        state.goals.finish(limited, measured_rad=measured_rad, soft=state.stiffness.soft, settled=settled)
        lease = state.authority.lease(now_s)
        return ControlOutput(
            list(state.motion.position_rad),
            state.mode,
            lease.epoch if lease else 0,
            state.stream.applied_sequence,
            state.stream.sent_ms,
            state.stream.loop_age_ms,
            limited,
            state.goals.twist,
            state.stops,
            state.authority.ended_input if lease else 0,
            requested_rad,
            state.stream.seen_tick_ms,
        )

    def record_applied(self, position_rad: Sequence[float]) -> None:
        """Compare the positions that the driver applied, shape (n,) [rad], with the command.

        While the robot moves itself, they are the command instead.
        """
        if self._state.handed_over:
            self._state.goals.start_at(position_rad)
        self._driver_limits = tuple(
            f"{joint.name}: driver"
            for joint, commanded, applied in zip(
                self._joints, self._state.motion.position_rad, position_rad, strict=True
            )
            if abs(commanded - applied) > _SAME_RAD
        )

    def record_driven(self, commanded: Twist, applied: Twist) -> None:
        """Compare the twist that the driver applied with the command."""
        differs = any(abs(a - b) > _SAME_TWIST for a, b in zip(commanded, applied, strict=True))
        self._base_limits = ("base: driver",) if differs else ()

    def _block(self, obstacle: Clearance) -> None:
        goals = self._state.goals
        if goals.goal is None:
            self._state.stream.block(obstacle)
            self._state.motion.brake()
        else:
            goals.goal.add_limits((obstacle.text,))
            goals.interrupt(
                Refused("no_room", f"an obstacle is in the way: {obstacle.text}; the device holds before it")
            )

    def _select_mode(self, now_s: float) -> Mode:
        authority, goals, stream = self._state.authority, self._state.goals, self._state.stream
        allowed = authority.restrictions.speed
        prevented = self._prevented(allowed)
        if prevented is not None:
            goals.brake()
            return prevented
        if authority.reservation is not None:
            goals.advance(allowed)
            return Mode.ACTION
        if stream.is_fresh(now_s, goals.braking_time_s(), late_s=self._late_s):
            stream.apply(self._state.motion, allowed=allowed)
            if goals.base is not None:
                stream.drive_base(goals.base, now_s, late_s=self._late_s, allowed=allowed)
            return Mode.STREAMING
        if self._state.mode is Mode.STREAMING and goals.faster_than(_CREEP_RAD_S):
            authority.end_input(Refused("watchdog", f"no setpoint for {1000 * stream.age_s(now_s):.0f} ms"))
        stream.clear()
        goals.brake()
        holds = self._state.mode is Mode.HOLDING and (goals.moving or authority.ended)
        return Mode.HOLDING if holds else Mode.IDLE

    def _prevented(self, allowed: float) -> Mode | None:
        """The mode in which the agent moves nothing, if it is in such a mode."""
        authority = self._state.authority
        if authority.fault is not None:
            return Mode.FAULT
        if self._state.handed_over:  # not stopped before the robot has ended its motion
            return Mode.HOLDING if authority.reservation is None else Mode.ACTION
        if authority.latch is not None:
            return Mode.STOPPED
        return Mode.HOLDING if allowed <= 0 else None

    def _requested(self) -> Sequence[float]:
        """Target of the present source before limits; empty if it has none."""
        if self._state.mode is Mode.STREAMING:
            return self._state.stream.requested_rad
        return self._state.goals.requested_rad if self._state.mode is Mode.ACTION else ()

    def _limited(self) -> tuple[str, ...]:
        """Limits that change the motion, for telemetry."""
        state = self._state
        strictest = state.authority.restrictions.strictest
        limited: tuple[str, ...] = () if strictest is None else (strictest.text,)
        if state.mode is Mode.STREAMING:
            limited += state.stream.limited
        return limited + state.motion.waits + state.stiffness.limited + self._driver_limits + self._base_limits

"""Streamed setpoints of one operator: the newest one applies while it is fresh."""

import math
from collections.abc import Sequence

from device_agent.ports.driver import REST, Twist
from device_agent.ports.geometry import Clearance, RobotGeometry
from device_agent.protocol import DriveTarget, JogTarget, JointTarget, Setpoint
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.base_motion import BaseMotion
from device_agent.runtime.control.joint_motion import JointMotion
from device_agent.runtime.control.latency_limiter import LIMITED, LatencyLimiter
from device_agent.runtime.control.limits import MotionLimits
from device_agent.runtime.errors import Refused

WATCHDOG_S = 0.3
"""The commanded velocity is zero this long after the last fresh setpoint [s]."""
MAX_LOOP_AGE_S = 0.2
"""Maximum age of the telemetry that a setpoint echoes [s]."""
_MIN_FRESH_S = 0.15
"""A setpoint applies at least this long, so that ordinary jitter does not stop the arm [s]."""
_MIN_FRESH_BASE_S = 0.1
"""The same for a base, which takes longer to stop [s]."""
_SAME_TARGET_RAD = 1e-4
"""A target that differs by less from a blocked one is the same target [rad]."""

_JOG_AHEAD_S = 0.5
"""A jog heads for the joint positions after this time, which is longer than braking takes [s]."""
_MIN_JOG_RAD_S = 1e-3
JOINT_SPEED = "speed: joints"
"""Name in ``limited`` of a jog that exceeds a joint's speed, for example near a singularity."""


class SetpointStream:
    """The newest setpoint and the motion that it requests. Not thread-safe: the controller locks.

    Attributes:
        applied_sequence: Sequence of the newest applied setpoint; 0 before the first one of a lease.
        sent_ms: The operator's clock in that setpoint.
        loop_age_ms: Loop age of the newest setpoint.
        seen_tick_ms: Tick that the newest applied setpoint echoes; 0 before the first one of a lease.
        requested_rad: Requested positions of all joints before limits; empty if no positions are requested.
    """

    def __init__(self, robot_type: RobotType, limits: MotionLimits, geometry: RobotGeometry | None) -> None:
        self._limits = limits
        self._geometry = geometry
        self._max_speeds = [joint.max_velocity_rad_s for joint in robot_type.joints]
        followers = {mirror.joint for mirror in robot_type.mimic_joints}
        self._leaders = {i: joint.name for i, joint in enumerate(robot_type.joints) if joint.name not in followers}
        self._names = [joint.name for joint in robot_type.joints]
        self._has_base = robot_type.base is not None
        self._limiter = LatencyLimiter(geometry, watchdog_s=WATCHDOG_S, max_age_s=MAX_LOOP_AGE_S)
        self._speed = robot_type.streaming_speed
        self._newest = (0, 0)
        self.reset([0.0] * len(robot_type.joints))

    def reset(self, position_rad: Sequence[float]) -> None:
        """Start for a new operator with the device at ``position_rad``, shape (n,) [rad]."""
        self._target = list(position_rad)
        self._setpoint: Setpoint | None = None
        self._joint_target: JointTarget | JogTarget | None = None
        self._twist = REST
        self._received_s = self._twist_received_s = -math.inf
        self._limiter.reset()
        self._range_limits: tuple[str, ...] = ()
        self._speed_limits: tuple[str, ...] = ()
        self._base_limits: tuple[str, ...] = ()
        self._obstacle: tuple[list[float], str] | None = None
        self.applied_sequence, self.sent_ms, self.loop_age_ms, self.seen_tick_ms = 0, 0.0, 0.0, 0
        self.requested_rad: tuple[float, ...] = ()

    def check(self, setpoint: Setpoint, *, tick_ms: int) -> None:
        """Check that a setpoint is newer than all before, also rejected ones, and that it echoes recent telemetry.

        Raises:
            Refused: It is not or does not.
        """
        newest = (setpoint.epoch, setpoint.sequence)
        if newest <= self._newest:
            raise Refused("out_of_order", "a newer setpoint has arrived already")
        self._newest = newest
        age_ms = tick_ms - setpoint.echo_tick_ms
        max_ms = MAX_LOOP_AGE_S * 1000
        if not 0 <= age_ms <= max_ms:
            raise Refused("too_old", f"echoes telemetry of {age_ms} ms ago; the maximum is {max_ms:.0f} ms")

    def accept(self, setpoint: Setpoint, *, now_s: float, tick_ms: int) -> None:
        """Accept a checked setpoint.

        A setpoint that arrived later than usual counts as received earlier, so that it does not move the device longer.

        Raises:
            Refused: Unknown joints, or values that are not finite.
        """
        self._check_target(setpoint.target)
        self._setpoint = setpoint
        self.loop_age_ms = float(tick_ms - setpoint.echo_tick_ms)
        self._limiter.add_age(self.loop_age_ms / 1000)
        self._received_s = now_s - max(0.0, self.loop_age_ms / 1000 - self._limiter.age_s)
        if isinstance(setpoint.target, DriveTarget):
            target = setpoint.target
            self._twist = Twist(target.forward_m_s, target.left_m_s, target.turn_rad_s)
            self._twist_received_s = self._received_s

    def _check_target(self, target: JointTarget | JogTarget | DriveTarget) -> None:
        match target:
            case JointTarget(position_rad=position_rad):
                self._limits.check(position_rad)
                return
            case DriveTarget(forward_m_s=forward, left_m_s=left, turn_rad_s=turn):
                if not self._has_base:
                    raise Refused("no_base", "this robot does not drive")
                parts: tuple[float, ...] = (forward, left, turn)
            case _:
                if self._geometry is None:
                    raise Refused("no_model", "this robot's type has no model; move its joints")
                if target.frame and target.frame not in self._geometry.frames:
                    frames = ", ".join(self._geometry.frames)
                    raise Refused("unknown_frame", f"no frame '{target.frame[:80]}'; there are {frames}")
                parts = (*target.linear_m_s, *target.angular_rad_s)
        if not all(map(math.isfinite, parts)):
            raise Refused("not_finite", "a velocity must be a finite number")

    def hold_here(self, position_rad: Sequence[float]) -> None:
        """Make ``position_rad``, shape (n,) [rad], the target of joints that the next setpoint does not name."""
        self._target, self.requested_rad = list(position_rad), ()

    def clear(self) -> None:
        """Apply no setpoint until the next one arrives."""
        self._received_s = self._twist_received_s = -math.inf

    @property
    def active(self) -> bool:
        """Whether there is a setpoint that may still apply."""
        return self._received_s > -math.inf

    def age_s(self, now_s: float) -> float:
        """Time since the newest setpoint [s]."""
        return now_s - self._received_s

    def is_fresh(self, now_s: float, braking_s: float, *, late_s: float) -> bool:
        """Whether the newest setpoint applies: braking after this period still ends before the watchdog time."""
        return _is_fresh(self.age_s(now_s), braking_s, late_s, _MIN_FRESH_S)

    def drive_base(self, base: BaseMotion, now_s: float, *, late_s: float, allowed: float) -> None:
        """Move the base at the newest twist while it is fresh; else brake.

        A zero twist means that the operator released the control: the base brakes instead of slowing down gently.
        """
        self._base_limits = ()
        fresh = _is_fresh(now_s - self._twist_received_s, base.braking_time_s(), late_s, _MIN_FRESH_BASE_S)
        if not fresh or self._twist == REST:
            base.brake()
            return
        limits = base.limits_to_stop_within(WATCHDOG_S - _MIN_FRESH_BASE_S)
        twist = Twist(*(min(max(part, -limit), limit) for part, limit in zip(self._twist, limits, strict=True)))
        share = self._limiter.unchecked_share()
        parts = zip(Twist._fields, self._twist, twist, strict=True)
        clamped = tuple(f"{name}: range" for name, requested, applied in parts if requested != applied)
        self._base_limits = clamped + ((LIMITED,) if share < 1.0 else ())
        base.follow(Twist(*(part * share * allowed for part in twist)))

    def apply(self, motion: JointMotion, *, allowed: float) -> None:
        """Move the joints towards the newest setpoint."""
        if self._setpoint is not None and self._setpoint.sequence != self.applied_sequence:
            self._set_target(self._setpoint.target, motion)
            self.applied_sequence, self.sent_ms = self._setpoint.sequence, self._setpoint.sent_ms
            self.seen_tick_ms = self._setpoint.echo_tick_ms
        if self._obstacle is not None and (motion.moving or _same(self._obstacle[0], self._requested())):
            # The motion brakes to rest before an obstacle, and continues when the operator requests another target.
            motion.brake()
            return
        self._obstacle = None
        cap = self._limiter.cap_rad_s(motion.position_rad, motion.velocity_rad_s, motion.braking_time_s())
        share = self._limiter.joint_share()
        speed = self._speed * share * allowed
        self._speed_limits = (LIMITED,) if share < 1.0 or cap < motion.max_speed_rad_s(speed) else ()
        if isinstance(self._joint_target, JogTarget):
            self._solve_jog(self._joint_target, motion, speed=speed, cap_rad_s=cap)
        else:
            motion.follow(self._target, speed=speed, cap_rad_s=cap)

    def _set_target(self, target: JointTarget | JogTarget | DriveTarget, motion: JointMotion) -> None:
        """Take over a new target. A target for the base leaves the joints unchanged."""
        if isinstance(target, DriveTarget):
            return
        if isinstance(self._joint_target, JogTarget):  # joints without a position stay where the jog has moved them
            self._target, self._range_limits = list(motion.position_rad), ()
        self._joint_target, self.requested_rad = target, ()
        if isinstance(target, JointTarget):
            self._range_limits = self._limits.clamp(target.position_rad, self._target)
            held = zip(self._names, self._target, strict=True)
            self.requested_rad = tuple(target.position_rad.get(name, position) for name, position in held)

    def _requested(self) -> list[float]:
        """The request for the joints as numbers, for comparison."""
        if isinstance(self._joint_target, JogTarget):
            return [*self._joint_target.linear_m_s, *self._joint_target.angular_rad_s]
        return list(self._target)

    def _solve_jog(self, jog: JogTarget, motion: JointMotion, *, speed: float, cap_rad_s: float) -> None:
        """Move the joints so that the frame moves at the jog's velocity.

        All joints slow down if one would be too fast, so that the frame keeps its direction.
        """
        if self._geometry is None or not any((*jog.linear_m_s, *jog.angular_rad_s)):
            self._target, self._range_limits = list(motion.position_rad), ()
            motion.brake()
            return
        frame = jog.frame or self._geometry.frames[-1]
        rates = self._geometry.rates(frame, (*jog.linear_m_s, *jog.angular_rad_s), motion.position_rad, tool=jog.tool)
        pairs = zip(rates, self._max_speeds, strict=True)
        excess = max(abs(rate) / min(limit * speed, cap_rad_s) for rate, limit in pairs)
        rates = tuple(rate / max(excess, 1.0) for rate in rates)
        ahead = {name: motion.position_rad[i] + rates[i] * _JOG_AHEAD_S for i, name in self._leaders.items()}
        self._target = list(motion.position_rad)
        self._range_limits = self._limits.clamp(ahead, self._target) + ((JOINT_SPEED,) if excess > 1.0 else ())
        max_rates = [max(abs(rate), _MIN_JOG_RAD_S) for rate in rates]
        motion.follow(self._target, speed=speed, cap_rad_s=cap_rad_s, max_rad_s=max_rates)

    def block(self, obstacle: Clearance) -> None:
        """Record an obstacle on the path to the present target."""
        self._obstacle = (self._requested(), obstacle.text)

    @property
    def limited(self) -> tuple[str, ...]:
        """Limits that change the requested motion."""
        obstacle = () if self._obstacle is None else (self._obstacle[1],)
        return self._range_limits + self._speed_limits + self._base_limits + obstacle


def _is_fresh(age_s: float, braking_s: float, late_s: float, min_fresh_s: float) -> bool:
    return age_s < max(min_fresh_s, WATCHDOG_S - braking_s - late_s)


def _same(one: Sequence[float], other: Sequence[float]) -> bool:
    return len(one) == len(other) and all(abs(a - b) <= _SAME_TARGET_RAD for a, b in zip(one, other, strict=True))

"""Streamed setpoints of one operator: the newest counts, while it is fresh."""

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
"""Commanded velocity is zero this long after the last fresh setpoint."""
MAX_LOOP_AGE_S = 0.2
"""A setpoint that answers telemetry older than this is not fresh."""
_SOONEST_BRAKING_S = 0.15
"""Braking never begins sooner than this after a setpoint, so that ordinary jitter does not stop the arm."""
_SOONEST_BASE_BRAKING_S = 0.1
"""The same of a base, which takes longer to stop."""
_NUDGE_RAD = 1e-4
"""A target that is nearer than this to one that was in the way is the same."""

_AHEAD_S = 0.5
"""A jog heads for where the joints would be after this time: further than they need to come to rest."""
_LEAST_RAD_S = 1e-3
JOINT_SPEED = "speed: joints"
"""As ``limited`` names a jog that joints are too slow for, as near a singularity."""


class SetpointStream:
    """What the newest setpoint asks of the joints. Not thread-safe: its owner locks.

    Args:
        robot_type: Share of the speed that setpoints may use.
        envelope: What positions may be.
        geometry: The robot's shape, if it is known.

    Attributes:
        taken: Sequence of the newest setpoint that the motors follow; 0 before the first of a lease.
        sent_ms: The operator's own clock in it.
        loop_age_ms: Its loop age.
    """

    def __init__(self, robot_type: RobotType, envelope: MotionLimits, geometry: RobotGeometry | None) -> None:
        self._envelope = envelope
        self._geometry = geometry
        self._limits = [joint.max_velocity_rad_s for joint in robot_type.joints]
        led = {mirror.joint for mirror in robot_type.mimic_joints}
        self._leading = {i: joint.name for i, joint in enumerate(robot_type.joints) if joint.name not in led}
        self._drives = robot_type.base is not None
        self._pace = LatencyLimiter(geometry, watchdog_s=WATCHDOG_S, oldest_s=MAX_LOOP_AGE_S)
        self._speed = robot_type.streaming_speed
        self.begin([0.0] * len(robot_type.joints))

    def begin(self, position_rad: Sequence[float]) -> None:
        """A new operator finds the device here, shape (n,) [rad]; what the one before said counts no more."""
        self._target = list(position_rad)
        self._setpoint: Setpoint | None = None
        self._hand: JointTarget | JogTarget | None = None
        self._drive = REST
        self._at_s = self._drive_at_s = -math.inf
        self._pace.begin()
        self._ranged: tuple[str, ...] = ()
        self._slowed: tuple[str, ...] = ()
        self._driven: tuple[str, ...] = ()
        self._obstacle: tuple[list[float], str] | None = None
        self.taken, self.sent_ms, self.loop_age_ms = 0, 0.0, 0.0

    def check(self, setpoint: Setpoint, *, tick_ms: int) -> None:
        """A setpoint is newer than the last, and answers what was seen a moment ago.

        Raises:
            Refused: It does not.
        """
        if self._setpoint is not None and setpoint.sequence <= self._setpoint.sequence:
            raise Refused("out_of_order", "a newer setpoint has arrived already")
        age_ms = tick_ms - setpoint.echo_tick_ms
        if not 0 <= age_ms <= MAX_LOOP_AGE_S * 1000:
            raise Refused(
                "too_old", f"answers telemetry of {age_ms} ms ago; {MAX_LOOP_AGE_S * 1000:.0f} ms is the most"
            )

    def take(self, setpoint: Setpoint, *, now_s: float, tick_ms: int) -> None:
        """Take in a setpoint that was checked.

        One that took longer than they have lately, on its way or in this process, is as old as the others would be:
        what comes late does not move the device for longer.

        Raises:
            Refused: Unknown joints, or numbers that are none.
        """
        self._check_target(setpoint.target)
        self._setpoint = setpoint
        self.loop_age_ms = float(tick_ms - setpoint.echo_tick_ms)
        self._pace.heard(self.loop_age_ms / 1000)
        self._at_s = now_s - max(0.0, self.loop_age_ms / 1000 - self._pace.age_s)
        if isinstance(setpoint.target, DriveTarget):
            target = setpoint.target
            self._drive, self._drive_at_s = Twist(target.forward_m_s, target.left_m_s, target.turn_rad_s), self._at_s

    def _check_target(self, target: JointTarget | JogTarget | DriveTarget) -> None:
        match target:
            case JointTarget(position_rad=position_rad):
                self._envelope.check(position_rad)
                return
            case DriveTarget(forward_m_s=forward, left_m_s=left, turn_rad_s=turn):
                if not self._drives:
                    raise Refused("no_base", "this robot does not drive")
                parts: tuple[float, ...] = (forward, left, turn)
            case _:
                if self._geometry is None:
                    raise Refused("no_model", "this robot's type has no model; move its joints")
                if target.frame and target.frame not in self._geometry.frames:
                    there = ", ".join(self._geometry.frames)
                    raise Refused("unknown_frame", f"no frame '{target.frame[:80]}'; there are {there}")
                parts = (*target.linear_m_s, *target.angular_rad_s)
        if not all(map(math.isfinite, parts)):
            raise Refused("not_finite", "a velocity must be a finite number")

    def stand(self, position_rad: Sequence[float]) -> None:
        """Something else has moved the device here, shape (n,) [rad]: joints that the next setpoint leaves out stay."""
        self._target = list(position_rad)

    def drop(self) -> None:
        """Follow no setpoint until the next one."""
        self._at_s = self._drive_at_s = -math.inf

    @property
    def heard(self) -> bool:
        """Whether a setpoint may still be followed."""
        return self._at_s > -math.inf

    def fresh(self, now_s: float, braking_s: float, *, late_s: float) -> bool:
        """Whether the newest setpoint is to be followed still: braking then ends in time.

        Args:
            now_s: Monotonic clock [s].
            braking_s: How long the device would brake [s].
            late_s: How late the control loop may be called next [s].
        """
        return _fresh(now_s - self._at_s, braking_s, late_s, _SOONEST_BRAKING_S)

    def steer(self, base: BaseMotion, now_s: float, *, late_s: float, allowed: float) -> None:
        """Set the base in motion as the newest setpoint for it asks, while that is fresh; else brake it.

        One that asks for rest has been let go: the base then brakes as it does without setpoints, and not as gently as
        it speeds up.

        Args:
            base: The base's motion.
            now_s: Monotonic clock [s].
            late_s: How late the control loop may be called next [s].
            allowed: Share of the speed that the room leaves, above 0.
        """
        self._driven = ()
        fresh = _fresh(now_s - self._drive_at_s, base.braking_time_s(), late_s, _SOONEST_BASE_BRAKING_S)
        if not fresh or self._drive == REST:
            base.brake()
            return
        limits = base.limits_to_stop_within(WATCHDOG_S - _SOONEST_BASE_BRAKING_S)
        twist = Twist(*(min(max(part, -most), most) for part, most in zip(self._drive, limits, strict=True)))
        share = self._pace.blind_share()
        parts = zip(Twist._fields, self._drive, twist, strict=True)
        ranged = tuple(f"{name}: range" for name, asked, done in parts if asked != done)
        self._driven = ranged + ((LIMITED,) if share < 1.0 else ())
        base.follow(Twist(*(part * share * allowed for part in twist)))

    def follow(self, motion: JointMotion, *, allowed: float) -> None:
        """Set the joints in motion towards the newest setpoint.

        Args:
            motion: Theirs.
            allowed: Share of the speed that the room leaves, above 0.
        """
        if self._setpoint is not None and self._setpoint.sequence != self.taken:
            self._take_up(self._setpoint.target, motion)
            self.taken, self.sent_ms = self._setpoint.sequence, self._setpoint.sent_ms
        if self._obstacle is not None and (motion.moving or _same(self._obstacle[0], self._asked())):
            # It had to brake before something: it does so to the end, and goes on when it is asked elsewhere.
            motion.brake()
            return
        self._obstacle = None
        cap = self._pace.cap_rad_s(motion.position_rad, motion.velocity_rad_s, motion.braking_time_s())
        share = self._pace.share()
        speed = self._speed * share * allowed
        self._slowed = (LIMITED,) if share < 1.0 or cap < motion.fastest_allowed_rad_s(speed) else ()
        if isinstance(self._hand, JogTarget):
            self._jog(self._hand, motion, speed=speed, cap_rad_s=cap)
        else:
            motion.follow(self._target, speed=speed, cap_rad_s=cap)

    def _take_up(self, target: JointTarget | JogTarget | DriveTarget, motion: JointMotion) -> None:
        """A setpoint is new: for joints, for a frame or for the base, which leaves the others to what they do."""
        if isinstance(target, DriveTarget):
            return
        if isinstance(self._hand, JogTarget):  # joints that are not named stay where it has brought them
            self._target, self._ranged = list(motion.position_rad), ()
        self._hand = target
        if isinstance(target, JointTarget):
            self._ranged = self._envelope.clamp(target.position_rad, self._target)

    def _asked(self) -> list[float]:
        """What is asked of the joints, to know it again."""
        if isinstance(self._hand, JogTarget):
            return [*self._hand.linear_m_s, *self._hand.angular_rad_s]
        return list(self._target)

    def _jog(self, jog: JogTarget, motion: JointMotion, *, speed: float, cap_rad_s: float) -> None:
        """Head for where the joints would be in a moment at the velocities that move the frame, at no more than those.

        All of them are slower when one would be too fast, so that the frame keeps its direction.
        """
        if self._geometry is None or not any((*jog.linear_m_s, *jog.angular_rad_s)):
            self._target, self._ranged = list(motion.position_rad), ()
            motion.brake()
            return
        frame = jog.frame or self._geometry.frames[-1]
        rates = self._geometry.rates(frame, (*jog.linear_m_s, *jog.angular_rad_s), motion.position_rad, tool=jog.tool)
        over = max(abs(rate) / min(limit * speed, cap_rad_s) for rate, limit in zip(rates, self._limits, strict=True))
        rates = tuple(rate / max(over, 1.0) for rate in rates)
        ahead = {name: motion.position_rad[i] + rates[i] * _AHEAD_S for i, name in self._leading.items()}
        self._target = list(motion.position_rad)
        self._ranged = self._envelope.clamp(ahead, self._target) + ((JOINT_SPEED,) if over > 1.0 else ())
        most = [max(abs(rate), _LEAST_RAD_S) for rate in rates]
        motion.follow(self._target, speed=speed, cap_rad_s=cap_rad_s, most_rad_s=most)

    def block(self, obstacle: Clearance) -> None:
        """Something is on the way to the newest setpoint."""
        self._obstacle = (self._asked(), obstacle.text)

    @property
    def limited(self) -> tuple[str, ...]:
        """What makes the motion other than asked."""
        return self._ranged + self._slowed + self._driven + (() if self._obstacle is None else (self._obstacle[1],))


def _fresh(age_s: float, braking_s: float, late_s: float, soonest_s: float) -> bool:
    return age_s < max(soonest_s, WATCHDOG_S - braking_s - late_s)


def _same(one: Sequence[float], other: Sequence[float]) -> bool:
    return len(one) == len(other) and all(abs(a - b) <= _NUDGE_RAD for a, b in zip(one, other, strict=True))

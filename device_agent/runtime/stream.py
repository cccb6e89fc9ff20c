"""Streamed setpoints of one operator: the newest counts, while it is fresh."""

import math
from collections.abc import Sequence

from device_agent.ports.geometry import Clearance, Geometry
from device_agent.protocol.messages import Setpoint
from device_agent.protocol.robot_type import RobotType
from device_agent.runtime.envelope import Envelope
from device_agent.runtime.lease import Refused
from device_agent.runtime.motion import Motion
from device_agent.runtime.pace import LIMITED, Pace

WATCHDOG_S = 0.3
"""Commanded velocity is zero this long after the last fresh setpoint."""
MAX_LOOP_AGE_S = 0.2
"""A setpoint that answers telemetry older than this is not fresh."""
_SOONEST_BRAKING_S = 0.15
"""Braking never begins sooner than this after a setpoint, so that ordinary jitter does not stop the arm."""
_NUDGE_RAD = 1e-4
"""A target that is nearer than this to one that was in the way is the same."""


class Stream:
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

    def __init__(self, robot_type: RobotType, envelope: Envelope, geometry: Geometry | None) -> None:
        self._envelope = envelope
        self._pace = Pace(geometry, watchdog_s=WATCHDOG_S, oldest_s=MAX_LOOP_AGE_S)
        self._speed = robot_type.streaming_speed
        self.begin([0.0] * len(robot_type.joints))

    def begin(self, position_rad: Sequence[float]) -> None:
        """A new operator finds the device here, shape (n,) [rad]; what the one before said counts no more."""
        self._target = list(position_rad)
        self._setpoint: Setpoint | None = None
        self._at_s = -math.inf
        self._pace.begin()
        self._ranged: tuple[str, ...] = ()
        self._slowed: tuple[str, ...] = ()
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
        self._envelope.check(setpoint.target.position_rad)
        self._setpoint = setpoint
        self.loop_age_ms = float(tick_ms - setpoint.echo_tick_ms)
        self._pace.heard(self.loop_age_ms / 1000)
        self._at_s = now_s - max(0.0, self.loop_age_ms / 1000 - self._pace.age_s)

    def stand(self, position_rad: Sequence[float]) -> None:
        """Something else has moved the device here, shape (n,) [rad]: joints that the next setpoint leaves out stay."""
        self._target = list(position_rad)

    def drop(self) -> None:
        """Follow no setpoint until the next one."""
        self._at_s = -math.inf

    @property
    def heard(self) -> bool:
        """Whether a setpoint may still be followed."""
        return self._at_s > -math.inf

    def fresh(self, now_s: float, motion: Motion, *, late_s: float) -> bool:
        """Whether the newest setpoint is to be followed still: braking then ends in time.

        Args:
            now_s: Monotonic clock [s].
            motion: The joints', which says how long they would brake.
            late_s: How late the control loop may be called next [s].
        """
        return now_s - self._at_s < max(_SOONEST_BRAKING_S, WATCHDOG_S - motion.braking_time_s() - late_s)

    def follow(self, motion: Motion, *, allowed: float) -> None:
        """Set the joints in motion towards the newest setpoint.

        Args:
            motion: Theirs.
            allowed: Share of the speed that the room leaves, above 0.
        """
        if self._setpoint is not None and self._setpoint.sequence != self.taken:
            self._ranged = self._envelope.clamp(self._setpoint.target.position_rad, self._target)
            self.taken, self.sent_ms = self._setpoint.sequence, self._setpoint.sent_ms
        if self._obstacle is not None and (motion.moving or _same(self._obstacle[0], self._target)):
            # It had to brake before something: it does so to the end, and goes on when it is asked elsewhere.
            motion.brake()
            return
        self._obstacle = None
        cap = self._pace.cap_rad_s(motion.position_rad, motion.velocity_rad_s, motion.braking_time_s())
        share = self._pace.share()
        speed = self._speed * share * allowed
        self._slowed = (LIMITED,) if share < 1.0 or cap < motion.fastest_allowed_rad_s(speed) else ()
        motion.follow(self._target, speed=speed, cap_rad_s=cap)

    def block(self, obstacle: Clearance) -> None:
        """Something is on the way to the newest setpoint."""
        self._obstacle = (list(self._target), obstacle.text)

    @property
    def limited(self) -> tuple[str, ...]:
        """What makes the motion other than asked."""
        return self._ranged + self._slowed + (() if self._obstacle is None else (self._obstacle[1],))


def _same(one: Sequence[float], other: Sequence[float]) -> bool:
    return all(abs(a - b) <= _NUDGE_RAD for a, b in zip(one, other, strict=True))

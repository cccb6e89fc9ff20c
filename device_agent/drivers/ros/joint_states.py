"""Measured joints from ``JointState`` messages of one or several publishers, matched by name."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from device_agent.middleware.ros.messages import NS, JointState

_MAX_DELAY_S = 1.0
"""A message that took this much longer than the fastest ones is outdated [s]."""
_WINDOW_S = 60.0
"""The fastest messages of one or two such windows count, because clocks drift [s]."""
_FRESH_S = (0.1, 0.3)
"""Bounds of the age of a measurement that counts as fresh [s]."""
_FRESH_INTERVALS = 3.0
_SMOOTHING = 0.1


@dataclass(frozen=True, slots=True)
class Measurement:
    """All joints, in the order of the robot type.

    Attributes:
        at_s: Arrival of the oldest value [s].
        fresh_until_s: When the next one is overdue: the connection stalls [s].
    """

    position_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    effort_nm: tuple[float, ...]
    at_s: float
    fresh_until_s: float


class _Joint(NamedTuple):
    position_rad: float
    velocity_rad_s: float
    effort_nm: float
    stamp_ns: int
    at_s: float
    known_new: bool


class JointStates:
    """Keeps the newest value of each joint. Written by one thread, read by any.

    Args:
        names: ROS names of the joints, in the order of the robot type.
        check_delay: Whether messages whose timestamps fall behind are rejected. A simulation may run slowly.

    Attributes:
        newest: The newest measurement; ``None`` until each joint has a second, newer timestamp.
    """

    def __init__(self, names: Sequence[str], *, check_delay: bool) -> None:
        self._names = tuple(names)
        self._joints: dict[str, _Joint] = {}
        self._delay = _Delay() if check_delay else None
        self._interval_s = 0.0
        self.newest: Measurement | None = None

    def accept(self, message: JointState, at_s: float) -> None:
        """Use a message that arrived at ``at_s`` [s]. One that contains none of the joints is ignored.

        Raises:
            ValueError: It is invalid, and nothing of it was used.
        """
        count, stamp_ns = len(message.name), message.header.stamp.ns
        if len(message.position) != count or {len(message.velocity), len(message.effort)} - {0, count}:
            raise ValueError("a JointState has fewer values than names")
        if len(set(message.name)) != count:
            raise ValueError("a JointState names a joint twice")
        ours = set(self._names) & set(message.name)
        if not ours:
            return
        if stamp_ns <= 0:
            raise ValueError("a JointState has no timestamp")
        if not all(map(math.isfinite, message.position)):
            raise ValueError("a position is not finite")
        if all(name in self._joints and stamp_ns <= self._joints[name].stamp_ns for name in ours):
            raise ValueError("the timestamps of JointState do not increase")
        if self._delay is not None:
            self._delay.check(stamp_ns / NS, at_s)
        for index, name in enumerate(message.name):
            if name in ours:
                self._update(message, index, at_s)
        self._merge()

    def missing(self, older_than_s: float) -> list[str]:
        """Joints without a new value since this time [s]."""
        return [
            name
            for name in self._names
            if name not in self._joints or not self._joints[name].known_new or self._joints[name].at_s < older_than_s
        ]

    def _update(self, message: JointState, index: int, at_s: float) -> None:
        name, position, stamp_ns = message.name[index], message.position[index], message.header.stamp.ns
        before = self._joints.get(name)
        if before is not None and stamp_ns <= before.stamp_ns:
            return
        velocity = message.velocity[index] if message.velocity else None
        effort = message.effort[index] if message.effort else None
        if velocity is None:
            velocity = 0.0
            if before is not None:
                velocity = (position - before.position_rad) / ((stamp_ns - before.stamp_ns) / NS)
        self._joints[name] = _Joint(position, velocity, effort or 0.0, stamp_ns, at_s, before is not None)

    def _merge(self) -> None:
        known = [joint for name in self._names if (joint := self._joints.get(name)) and joint.known_new]
        if len(known) < len(self._names):
            return
        at_s = min(joint.at_s for joint in known)
        if self.newest is not None and at_s > self.newest.at_s:
            elapsed_s = min(at_s - self.newest.at_s, _FRESH_S[1])
            self._interval_s += _SMOOTHING * (elapsed_s - self._interval_s)
        self.newest = Measurement(
            tuple(joint.position_rad for joint in known),
            tuple(joint.velocity_rad_s for joint in known),
            tuple(joint.effort_nm for joint in known),
            at_s,
            at_s + min(max(_FRESH_INTERVALS * self._interval_s, _FRESH_S[0]), _FRESH_S[1]),
        )


class _Delay:
    """Compares the age of messages with the lowest one; the clocks of robot and agent need not agree."""

    def __init__(self) -> None:
        self._lowest_s = math.inf
        self._previous_s = math.inf
        self._until_s = -math.inf

    def check(self, stamp_s: float, at_s: float) -> None:
        """Check one message.

        Raises:
            ValueError: It is outdated.
        """
        age_s = at_s - stamp_s
        if at_s > self._until_s:
            self._previous_s, self._lowest_s, self._until_s = self._lowest_s, age_s, at_s + _WINDOW_S
        self._lowest_s = min(self._lowest_s, age_s)
        late_s = age_s - min(self._lowest_s, self._previous_s)
        if late_s > _MAX_DELAY_S:
            raise ValueError(f"a JointState is {late_s:.1f} s late")

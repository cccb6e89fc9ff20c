"""Measures how long a robot moved in each lease, and who moved it: an operator, or a machine."""

import math
from dataclasses import dataclass

import msgspec

from device_agent.protocol import Mode
from device_agent.protocol.events import Activity, EventKind
from device_agent.runtime.authority.event_recorder import EventRecord, RecordEvent

REPORT_S = 10.0
"""Time between two reports of a lease [s]."""
REST_S = 1.0
"""Time after which a robot that came to rest reports [s], if its last report is old enough."""
MAX_ELAPSED_S = 0.3
"""Longest time that one period counts [s]: a robot whose control loop hangs is at rest after the watchdog's time."""


@dataclass(slots=True)
class _Activity:
    """Sums of one lease; the times are 0 until something moved."""

    epoch: int
    operator_s: float = 0.0
    machine_s: float = 0.0
    first_input_s: float | None = None


class ActivityMeter:
    """Sums the moving time of each lease by its source, and records the sums as events.

    Motion while the operator's setpoints are followed is the operator's. All other motion is the machine's: movements,
    behaviours of the robot, braking after a hold. Not thread-safe: only the control loop calls it.

    Args:
        record: Records the events; never blocks.
    """

    def __init__(self, record: RecordEvent) -> None:
        self._record = record
        self._activity = _Activity(0)
        self._since_s = 0.0
        self._previous_s = math.inf
        self._moved_s = self._unreported_s = self._reported_s = -math.inf
        self._reported = True

    def record_period(self, now_s: float, *, epoch: int, mode: Mode, moving: bool) -> None:
        """Count one control period.

        Args:
            now_s: Monotonic clock [s].
            epoch: Newest epoch of the device; a new one ends the former lease's sums.
            mode: Mode of the period.
            moving: Whether the robot moves.
        """
        elapsed_s = min(max(now_s - self._previous_s, 0.0), MAX_ELAPSED_S)
        self._previous_s = now_s
        if epoch != self._activity.epoch:
            self.report(now_s)
            self._activity, self._since_s, self._reported_s = _Activity(epoch), now_s, -math.inf
        if moving:
            self._count(now_s, elapsed_s, operator=mode is Mode.STREAMING)
        due_s = self._unreported_s + REPORT_S if moving else self._moved_s + REST_S
        if now_s >= max(due_s, self._reported_s + REPORT_S):
            self.report(now_s)

    def _count(self, now_s: float, elapsed_s: float, *, operator: bool) -> None:
        activity = self._activity
        if operator:
            activity.operator_s += elapsed_s
            if activity.first_input_s is None:
                activity.first_input_s = now_s - self._since_s
        else:
            activity.machine_s += elapsed_s
        if self._reported:
            self._reported, self._unreported_s = False, now_s
        self._moved_s = now_s

    def report(self, now_s: float) -> None:
        """Record the sums now, for example because the agent ends. ``now_s``: monotonic clock [s]."""
        if self._reported:
            return
        activity = self._activity
        data = Activity(
            epoch=activity.epoch,
            operator_s=round(activity.operator_s, 4),
            machine_s=round(activity.machine_s, 4),
            first_input_s=activity.first_input_s,
        )
        message = f"moved {activity.operator_s:.1f} s by an operator and {activity.machine_s:.1f} s by itself"
        self._record(EventRecord(EventKind.ACTIVITY, message, data=msgspec.to_builtins(data)))
        self._reported, self._reported_s = True, now_s

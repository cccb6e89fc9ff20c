"""Faults to report: each condition is raised at once, and cleared after it has been absent for a stable time.

A condition that comes and goes, such as a camera at the edge of its time limit, is one fault with a count.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from msgspec.structs import replace

from device_agent.ports.clock import wall_ms
from device_agent.protocol import Fault


@dataclass(slots=True)
class _Open:
    """A reported fault: whether its condition is present, and when it was last present [s]."""

    fault: Fault
    seen_s: float
    present: bool = True


@dataclass(frozen=True, slots=True)
class FaultChanges:
    """Faults that were raised or cleared by an update."""

    raised: list[Fault] = field(default_factory=list)
    cleared: list[Fault] = field(default_factory=list)


class FaultReporter:
    """Open faults by code. Not thread-safe.

    Args:
        stable_s: A fault is cleared when its condition has been absent for this long [s].
        clock_s: Monotonic clock [s].
    """

    def __init__(self, *, stable_s: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._stable_s = stable_s
        self._clock_s = clock_s
        self._open: dict[str, _Open] = {}

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Open faults, oldest first, with the newest message of each."""
        return tuple(each.fault for each in self._open.values())

    def update(self, present: Sequence[Fault]) -> FaultChanges:
        """Compare the conditions that are present now with the open faults."""
        now_s, changes = self._clock_s(), FaultChanges()
        present_codes = {fault.code for fault in present}
        for fault in present:
            existing = self._open.get(fault.code)
            if existing is None:
                self._open[fault.code] = _Open(replace(fault, last_ms=wall_ms()), now_s)
                changes.raised.append(fault)
                continue
            again = existing.fault.count + (not existing.present)
            existing.fault = replace(existing.fault, message=fault.message, count=again, last_ms=wall_ms())
            existing.present, existing.seen_s = True, now_s
        for code, existing in list(self._open.items()):
            if code in present_codes:
                continue
            existing.present = False
            if now_s - existing.seen_s >= self._stable_s:
                changes.cleared.append(self._open.pop(code).fault)
        return changes

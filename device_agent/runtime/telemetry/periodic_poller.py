"""Polls several sources, each at its own rate, in one thread."""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from device_agent.ports.driver import DriverError
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.protocol import Stream

_RESPONSE_S = 15.0
"""A poll that takes longer hangs [s]; the renderer of a simulated camera has a timeout of 10 s."""
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Schedule:
    """Period of a source [s], time of its next poll [s], and its last error."""

    period_s: float
    due_s: float = -math.inf
    error: str = ""


class PeriodicPoller:
    """Polls each source at its rate until it is stopped. Missed polls are dropped.

    ``poll`` is called with the name of a source. It may block, and raise ``DriverError``. ``share`` is the share of
    their rates at which the sources are polled now.
    """

    def __init__(
        self,
        sources: Iterable[Stream],
        poll: Callable[[str], None],
        *,
        device: str,
        kind: str,
        share: Callable[[], float],
    ) -> None:
        self._poll = poll
        self._share = share
        self._label = f"{device}: {kind}"
        self._schedules = {source.name: _Schedule(1 / source.rate_hz) for source in sources}
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name=f"{device}-{kind}",
            part=f"{kind} thread",
            device=device,
            stopping=self._stopping,
            recovery=Recovery.RESTART,
        )

    def start(self) -> None:
        """Start to poll, if there are sources."""
        if self._schedules:
            self._thread.start()

    def stop(self) -> None:
        """Stop. May be called twice."""
        self._stopping.set()
        self._thread.join(timeout=2)

    def _run(self) -> None:
        wait_s = 0.0
        while not self._stopping.wait(wait_s):
            now_s = time.monotonic()
            for name, schedule in self._schedules.items():
                if schedule.due_s <= now_s:
                    self._thread.beat(_RESPONSE_S)
                    period_s = schedule.period_s / self._share()
                    next_s = schedule.due_s + period_s
                    schedule.due_s = next_s if next_s > now_s else now_s + period_s
                    self._log_change(name, schedule, self._poll_once(name))
            wait_s = max(0.0, min(schedule.due_s for schedule in self._schedules.values()) - time.monotonic())
            self._thread.beat(wait_s + _RESPONSE_S)

    def _poll_once(self, name: str) -> str:
        """Poll a source; returns the error message, or an empty string."""
        try:
            self._poll(name)
        except DriverError as error:
            return str(error)
        except Exception as error:  # noqa: BLE001 (an error of one source must not stop the others)
            return f"internal error: {error!r}"
        return ""

    def _log_change(self, name: str, schedule: _Schedule, error: str) -> None:
        """Log an error when it starts and ends, not at each poll."""
        if error != schedule.error:
            schedule.error = error
            _log.warning("%s %s: %s", self._label, name, error or "works again")

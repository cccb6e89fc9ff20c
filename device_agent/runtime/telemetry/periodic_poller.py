"""Asks for several things, each at its own rate, in a thread of its own: one that is slow must not cost a period."""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from device_agent.ports.driver import DriverError
from device_agent.protocol import Stream

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Due:
    """One thing: its period [s], when it is next asked for [s], and what is wrong with it."""

    period_s: float
    due_s: float = -math.inf
    trouble: str = ""


class PeriodicPoller:
    """Asks, at each one's rate, until it is stopped. What was missed is not made up for.

    Args:
        things: What is asked for, and how often.
        ask: Called with the name of one; may take its time, and raise ``DriverError``.
        device: The device's name, for the log; ``what``: the kind of thing, for the log too.
    """

    def __init__(self, things: Iterable[Stream], ask: Callable[[str], None], *, device: str, what: str) -> None:
        self._ask = ask
        self._called = f"{device}: {what}"
        self._things = {thing.name: _Due(1 / thing.rate_hz) for thing in things}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{device}-{what}", daemon=True)

    def start(self) -> None:
        """Begin, where there is something to ask for."""
        if self._things:
            self._thread.start()

    def stop(self) -> None:
        """End. May be called twice."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2)

    def _run(self) -> None:
        wait_s = 0.0
        while not self._stopping.wait(wait_s):
            now_s = time.monotonic()
            for name, due in self._things.items():
                if due.due_s <= now_s:
                    following_s = due.due_s + due.period_s
                    due.due_s = following_s if following_s > now_s else now_s + due.period_s
                    self._note(name, due, self._trouble(name))
            wait_s = max(0.0, min(due.due_s for due in self._things.values()) - time.monotonic())

    def _trouble(self, name: str) -> str:
        """Ask for it; what went wrong, or nothing."""
        try:
            self._ask(name)
        except DriverError as error:
            return str(error)
        except Exception as error:  # noqa: BLE001 (one that goes wrong must not end all of them)
            return f"internal error: {error!r}"
        return ""

    def _note(self, name: str, due: _Due, trouble: str) -> None:
        """Log trouble when it comes and when it goes, not each time."""
        if trouble != due.trouble:
            due.trouble = trouble
            _log.warning("%s %s: %s", self._called, name, trouble or "is measured again")

"""Watchdog for devices that continue to move without commands, such as velocity interfaces."""

import contextlib
import threading
import time
from collections.abc import Callable
from functools import partial

from device_agent.ports.driver import DriverError
from device_agent.ports.threads import Recovery, SupervisedThread

TIMEOUT_S = 0.3
"""Longest time between two commands [s]; see ``MobileDriver``."""
_RESPONSE_S = 2.0


class CommandWatchdog:
    """Brakes the device from its own thread if no command was sent for ``timeout_s``. Thread-safe.

    Prefer a watchdog in the device: this one ends with the agent's process.

    Args:
        brake: Brings the device to rest. It may be called repeatedly, and again after a ``DriverError``.
        device: Id of the device at its agent.
        timeout_s: Longest time between two commands [s].
    """

    def __init__(self, brake: Callable[[], None], *, device: str, timeout_s: float = TIMEOUT_S) -> None:
        self._brake = brake
        self._device = device
        self._timeout_s = timeout_s
        self._fed_s: float | None = None
        self._stopping = threading.Event()
        self._thread: SupervisedThread | None = None

    def start(self) -> None:
        """Start to watch."""
        self._fed_s = None
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            partial(self._run, self._stopping),
            name=f"{self._device}-watchdog",
            part="watchdog of the driver",
            stopping=self._stopping,
            recovery=Recovery.RESTART,
            device=self._device,
            within_s=_RESPONSE_S,
        )
        self._thread.start()

    def feed(self) -> None:
        """Record that a command was sent."""
        self._fed_s = time.monotonic()

    def stop(self) -> None:
        """End the thread. May be called repeatedly."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(_RESPONSE_S)

    def _run(self, stopping: threading.Event) -> None:
        thread = self._thread
        while not stopping.wait(self._timeout_s / 4):
            if thread is not None:
                thread.beat()
            fed_s = self._fed_s
            if fed_s is None or time.monotonic() - fed_s < self._timeout_s:
                continue
            with contextlib.suppress(DriverError):  # otherwise again at the next check
                self._brake()
                if self._fed_s == fed_s:
                    self._fed_s = None

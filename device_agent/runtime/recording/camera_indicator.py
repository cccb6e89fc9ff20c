"""The indicator in the room: a control of a room device that is on while cameras are recorded.

It is set in a thread of its own, because a device may take any time. Without its confirmation no camera is recorded.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping

from device_agent.config.agent_config import Indicator
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.runtime.errors import INTERNAL_ERROR, Refused
from device_agent.runtime.room.room_device import RoomDevice

REPEAT_S = 10.0
"""The indicator is set again after this time [s], so that one that was switched off or lost is noticed."""
RETRY_S = 3.0
"""Time after a failure until the next attempt [s]."""
VALID_S = 30.0
"""Without a confirmation for this time, the indicator counts as off [s]."""
_POLL_S = 0.1
_STOP_S = 5.0
_log = logging.getLogger(__name__)


class CameraIndicator:
    """The indicator of one agent. Thread-safe.

    Args:
        settings: Which control it is, and its values.
        devices: Room devices of the agent by name; complete when ``start`` is called.
        clock_s: Monotonic clock [s].
    """

    def __init__(
        self, settings: Indicator, devices: Mapping[str, RoomDevice], *, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._settings = settings
        self._devices = devices
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._required = False
        self._since_s = float("inf")
        self._confirmed_s = self._due_s = float("-inf")
        self._off = False  # unknown at the start: a crash may have left it on
        self._error = ""
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name="camera-indicator",
            part="indicator of recorded cameras",
            stopping=self._stopping,
            recovery=Recovery.RESTART,
        )

    def start(self) -> None:
        """Start to set the indicator."""
        self._thread.start()

    def stop(self) -> None:
        """Switch it off and end. May be called twice."""
        self._stopping.set()
        self.require(False)
        self._thread.join(_STOP_S)

    def require(self, required: bool) -> None:
        """Request that the indicator is on or off; never blocks. After ``stop`` it stays off."""
        with self._lock:
            required = required and not self._stopping.is_set()
            if required != self._required:
                self._required = required
                self._since_s = float("inf")
                self._confirmed_s = self._due_s = float("-inf")
                self._error = ""

    @property
    def shown(self) -> bool:
        """Whether the indicator is required, and its device has confirmed lately that it is on."""
        return self._clock_s() - self._confirmed_s < VALID_S

    def covers(self, at_s: float) -> bool:
        """Whether the indicator is on, and has been on since this time [s] or longer."""
        return self.shown and at_s >= self._since_s

    @property
    def error(self) -> str:
        """Why a required indicator is not on; empty if it is, or was not set yet."""
        return self._error if self._required and not self.shown else ""

    def _run(self) -> None:
        while not self._stopping.wait(_POLL_S):
            self.step()
        self.require(False)
        self.step()

    def step(self) -> None:
        """Set the indicator if that is due."""
        with self._lock:
            required, due = self._required, self._clock_s() >= self._due_s
        if not due or (self._off and not required):
            return
        self._off = False
        error = self._set(on=required)
        with self._lock:
            self._off = not required and not error
            if required != self._required:
                return  # the next step sets it again
            now_s = self._clock_s()
            self._due_s = now_s + (RETRY_S if error else REPEAT_S)
            lit = required and not error
            if lit and not self.shown:
                self._since_s = now_s
            self._confirmed_s = now_s if lit else float("-inf")
            if error and error != self._error:
                _log.warning("the indicator of recorded cameras: %s", error)
            self._error = error

    def _set(self, *, on: bool) -> str:
        """Set the control; returns the error, or an empty string."""
        settings = self._settings
        value, other = (settings.on, settings.off) if on else (settings.off, settings.on)
        try:
            applied = self._devices[settings.device].set(settings.control, value)
        except Refused as refused:
            return refused.message
        except Exception:  # noqa: BLE001 (in doubt, cameras are not recorded)
            _log.exception("the indicator of recorded cameras")
            return INTERNAL_ERROR
        if abs(applied - value) >= abs(applied - other):
            return f"'{settings.device}' has set {settings.control} to {applied:g} instead of {value:g}"
        return ""

"""Actions of room devices: collect data, measure once, capture raw data, set a control."""

import threading
import time
from collections.abc import Callable
from typing import Any

from device_agent.protocol import CaptureRaw, CollectData, RoomTask, TakePicture
from device_agent.runtime.errors import Refused
from device_agent.runtime.room.room_device import RoomDevice

_PROGRESS_PERIOD_S = 1.0
_STEPS = 100
"""Number of progress reports of a collection, if they are at least ``_PROGRESS_PERIOD_S`` apart."""

OnOutput = Callable[[str, float | None], None]
"""Called with printed output and progress."""


class CollectAction:
    """Reads streams at another rate for a time; subscribers receive the measurements."""

    def __init__(self, request: CollectData, room_device: RoomDevice, on_output: OnOutput) -> None:
        self._request = request
        self._room_device = room_device
        self._on_output = on_output
        self._killed = threading.Event()

    def run(self) -> dict[str, Any]:
        """Run until the duration has passed, or until ``kill``; returns the number of samples of each stream."""
        start_s, duration_s = time.monotonic(), self._request.duration_s
        streams = self._room_device.collect(self._request.streams, self._request.rate_hz)
        try:
            while not self._killed.is_set():
                elapsed_s = time.monotonic() - start_s
                if elapsed_s >= duration_s:
                    break
                step_s = min(duration_s - elapsed_s, max(_PROGRESS_PERIOD_S, duration_s / _STEPS))
                if not self._killed.wait(step_s):
                    self._on_output("", min(1.0, (time.monotonic() - start_s) / duration_s))
        finally:
            counts = self._room_device.idle()
        return {"samples": {stream: counts.get(stream, 0) for stream in streams}}

    def kill(self) -> None:
        """End it, from any thread."""
        self._killed.set()


class OneShotAction:
    """One call of the device, which takes as long as the device needs."""

    def __init__(self, call: Callable[[], dict[str, Any]]) -> None:
        self._call = call

    def run(self) -> dict[str, Any]:
        """Call the device."""
        return self._call()

    def kill(self) -> None:
        """Do nothing: the end of the reservation ends motion, measurements are short, and the loop applies Stop."""


def create(request: RoomTask, room_device: RoomDevice | None, on_output: OnOutput) -> CollectAction | OneShotAction:
    """The action for a request.

    Raises:
        Refused: The device is not a room device.
    """
    if room_device is None:
        raise Refused("cannot", "this is not a room device: it cannot collect, capture or set anything")
    match request:
        case CollectData():
            return CollectAction(request, room_device, on_output)
        case TakePicture(streams=streams):
            return OneShotAction(lambda: {"values": room_device.take_picture(streams)})
        case CaptureRaw(name=name):
            return OneShotAction(lambda: room_device.capture_raw(name))
    return OneShotAction(lambda: {"applied": {request.control: room_device.set(request.control, request.value)}})

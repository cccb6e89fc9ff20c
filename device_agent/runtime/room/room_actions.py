"""Actions of room devices: gather for a while, measure once, take something raw, set something."""

import threading
import time
from collections.abc import Callable
from typing import Any

from device_agent.protocol import CaptureRaw, CollectData, RoomTask, TakePicture
from device_agent.runtime.errors import Refused
from device_agent.runtime.room.room_device import RoomDevice

_TELL_EVERY_S = 1.0
_STEPS = 100
"""Progress is told so often over the length of a gathering, once a second at most."""

Tell = Callable[[str, float | None], None]
"""What was printed, and how much is done."""


class Gathering:
    """Reads some streams at another rate for a while, and then again as before. Whoever listens hears of it."""

    def __init__(self, order: CollectData, instrument: RoomDevice, tell: Tell) -> None:
        self._order = order
        self._instrument = instrument
        self._tell = tell
        self._over = threading.Event()

    def run(self) -> dict[str, Any]:
        """Until its time is over, or until ``kill``."""
        began_s, duration_s = time.monotonic(), self._order.duration_s
        streams = self._instrument.gather(self._order.streams, self._order.rate_hz)
        try:
            while not self._over.is_set():
                passed_s = time.monotonic() - began_s
                if passed_s >= duration_s:
                    break
                step_s = min(duration_s - passed_s, max(_TELL_EVERY_S, duration_s / _STEPS))
                if not self._over.wait(step_s):
                    self._tell("", min(1.0, (time.monotonic() - began_s) / duration_s))
        finally:
            counts = self._instrument.rest()
        return {"samples": {stream: counts.get(stream, 0) for stream in streams}}

    def kill(self) -> None:
        """End it, from any thread."""
        self._over.set()


class Once:
    """Something that is asked of the device once, and takes as long as it takes."""

    def __init__(self, deed: Callable[[], dict[str, Any]]) -> None:
        self._deed = deed

    def run(self) -> dict[str, Any]:
        """Do it."""
        return self._deed()

    def kill(self) -> None:
        """It is not broken off: a measurement or upload ends by itself, and a Stop reaches what moves by the loop."""


def activity(order: RoomTask, instrument: RoomDevice | None, tell: Tell) -> Gathering | Once:
    """What does this order.

    Raises:
        Refused: The device is none of a room.
    """
    if instrument is None:
        raise Refused("cannot", "this is no device of a room: it gathers, captures and sets nothing")
    match order:
        case CollectData():
            return Gathering(order, instrument, tell)
        case TakePicture(streams=streams):
            return Once(lambda: {"values": instrument.shoot(streams)})
        case CaptureRaw(name=name):
            return Once(lambda: instrument.capture(name))
    return Once(lambda: {"applied": {order.control: instrument.set(order.control, order.value)}})

"""One subscriber: ``python -m benchmarks.scale.subscriber``.

The program reads one line of JSON (``SubscriberOptions``), subscribes and prints ``ready``. For each further line, it
waits until no messages arrive and prints those since the previous line as JSON (``SubscriberResult``).
"""

import sys
import threading
import time
from typing import Final

import msgspec

from benchmarks.reporting.report import percentile
from benchmarks.scale import mqtt_packets
from benchmarks.scale.publishers import SENT

_IDLE_S: Final = 0.5
_BUFFER_BYTES: Final = 262_144
MEASURED: Final = b'"at_ms":'
"""Marks the time of a measurement on the wall clock [ms]."""


class SubscriberOptions(msgspec.Struct):
    """Options of the subscriber."""

    port: int
    client: str
    user: str
    password: str
    topic: str
    wall: bool = False
    """True if messages contain the measurement time (wall clock) instead of the send time (monotonic clock)."""


class SubscriberResult(msgspec.Struct):
    """Received messages; ``ms``: percentiles of the time from the publisher's clock."""

    count: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    processor_s: float


class Listener:
    """Receives messages in its own thread."""

    def __init__(self, options: SubscriberOptions) -> None:
        self._clock, self._mark = (time.time, MEASURED) if options.wall else (time.monotonic, SENT)
        self._connection = mqtt_packets.connect(options.port, options.client, options.user, options.password)
        mqtt_packets.subscribe(self._connection, options.topic)
        self._connection.settimeout(None)
        self._delays_ms: list[float] = []
        self._spent_s = time.process_time()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        buffer = bytearray()
        while data := self._connection.recv(_BUFFER_BYTES):
            now_ms = self._clock() * 1000
            buffer += data
            for kind, body in mqtt_packets.packets(buffer):
                if kind & 0xF0 == mqtt_packets.PUBLISH:
                    self._delays_ms.append(now_ms - timestamp_ms(body, self._mark))

    def take_result(self) -> SubscriberResult:
        """Returns the result since the last call."""
        count = -1
        while count != len(self._delays_ms):
            count = len(self._delays_ms)
            time.sleep(_IDLE_S)
        delays_ms, self._delays_ms = self._delays_ms, []
        spent_s, self._spent_s = time.process_time() - self._spent_s, time.process_time()
        samples = delays_ms or [0.0]
        return SubscriberResult(
            len(delays_ms), percentile(samples, 0.5), percentile(samples, 0.99), max(samples), spent_s
        )


def timestamp_ms(body: bytes, mark: bytes) -> float:
    """Returns the time behind a marker in a message [ms]."""
    return float(body[body.rindex(mark) + len(mark) :].split(b",", 1)[0])


def main() -> None:
    """Runs until standard input ends."""
    listener = Listener(msgspec.json.decode(sys.stdin.readline(), type=SubscriberOptions))
    print("ready", flush=True)
    for _ in sys.stdin:
        print(msgspec.json.encode(listener.take_result()).decode(), flush=True)


if __name__ == "__main__":
    main()

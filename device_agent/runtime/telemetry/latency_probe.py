"""How long it takes from the device to the other side and back: taken from messages that are sent anyway.

A state or an answer goes out with a request to confirm it; from handing it over to that confirmation is what a message
takes: over MQTT to the broker and back, over HTTP and XMPP to the cloud. One clock measures, and nothing is sent for
the sake of measuring. Samples go to the cloud now and then, and are dropped where they cannot: they are not needed.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

from device_agent.ports.transport import LinkChanged, Receive, Transport
from device_agent.protocol import topics

Sample = tuple[int, float]
"""When, by the wall clock [ms since 1970], and how long [ms]."""
Tell = Callable[[str, Sequence[Sample]], None]
"""Called with a device and its samples, on a thread that may wait; raises ``OSError`` or ``ValueError``."""

ROUND_S = 10.0
"""Samples of one device go to the cloud so often; those of the next one then."""
AGAIN_S = 60.0
"""The same device's samples go at most so often."""
SPACING_S = 1.0
"""Of what a device says in quick succession one is timed: what stands in a queue behind others tells of the queue."""
MOST = 100
"""Samples of one device that wait; beyond these the newest stay."""
_TIMED = frozenset({topics.STATE, topics.ACK})
"""Said live and confirmed. What was kept while off line is sent in bulk, and would tell of that."""
_log = logging.getLogger(__name__)


class LatencyProbe:
    """A transport, as the one that it is given, whose messages are timed.

    Args:
        transport: What sends. Not yet started.
        tell: Tells the cloud.
        at_ms: The time that samples are dated with [ms since 1970].
        round_s: See ``ROUND_S``.
        again_s: See ``AGAIN_S``.
        spacing_s: See ``SPACING_S``.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        tell: Tell,
        at_ms: Callable[[], int],
        round_s: float = ROUND_S,
        again_s: float = AGAIN_S,
        spacing_s: float = SPACING_S,
    ) -> None:
        self._transport = transport
        self._tell = tell
        self._at_ms = at_ms
        self._round_s = round_s
        self._again_s = again_s
        self._spacing_s = spacing_s
        self._lock = threading.Lock()
        self._timed_s: dict[str, float] = {}
        self._samples: dict[str, deque[Sample]] = {}
        self._told_s: dict[str, float] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="round-trips", daemon=True)

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        """See ``Transport.start``."""

        def changed(up: bool) -> None:
            if not up:
                with self._lock:
                    self._samples.clear()
            link_changed(up)

        self._transport.start(receive, changed)
        self._thread.start()

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,
        delivered: Callable[[], None] | None = None,
    ) -> bool:
        """See ``Transport.publish``."""
        device = self._to_be_timed(topic) if qos else None
        if device is not None:
            delivered = partial(self._came_back, device, time.monotonic(), delivered)
        return self._transport.publish(topic, payload, qos=qos, retain=retain, delivered=delivered)

    def stop(self) -> None:
        """See ``Transport.stop``. What was not told is dropped."""
        self._stopping.set()
        self._transport.stop()

    def _to_be_timed(self, topic: str) -> str | None:
        """The device whose message this is, if it is one to be timed now."""
        parsed = topics.parse(topic)
        if parsed.kind not in _TIMED:
            return None
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._timed_s.get(parsed.device, -self._spacing_s) < self._spacing_s:
                return None
            self._timed_s[parsed.device] = now_s
        return parsed.device

    def _came_back(self, device: str, sent_s: float, delivered: Callable[[], None] | None) -> None:
        ms = (time.monotonic() - sent_s) * 1000
        sample = (self._at_ms(), round(ms, 3))
        with self._lock:
            self._samples.setdefault(device, deque(maxlen=MOST)).append(sample)
        if delivered is not None:
            delivered()

    # ------------------------------------------------------------ the thread that tells

    def _run(self) -> None:
        while not self._stopping.wait(self._round_s):
            self._tell_one()

    def _tell_one(self) -> None:
        """Tell the samples of the device that has waited longest; what the cloud does not take is dropped."""
        now_s = time.monotonic()
        with self._lock:
            due = (name for name in self._samples if now_s - self._told_s.get(name, -self._again_s) >= self._again_s)
            device = min(due, key=lambda name: self._told_s.get(name, 0.0), default=None)
            if device is None:
                return
            samples = tuple(self._samples.pop(device))
            self._told_s[device] = now_s
        try:
            self._tell(device, samples)
        except (OSError, ValueError) as error:
            _log.info("%d round trips of %s are not told: %s", len(samples), device, error)
        except Exception:  # noqa: BLE001 (there are other samples)
            _log.exception("telling round trips of %s", device)

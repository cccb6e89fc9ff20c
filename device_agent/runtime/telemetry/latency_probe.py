"""Latency probe: measures round-trip times from messages that need an acknowledgement.

A sample is the time from sending a state to its acknowledgement: to the broker over MQTT, to the cloud over HTTP and
XMPP. One clock measures both ends, and there are no additional messages. Samples that cannot be uploaded are
dropped.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.ports.transport import LinkChanged, Receive, Transport
from device_agent.protocol import topics

Sample = tuple[int, float]
"""Wall-clock time [ms since 1970], and round-trip time [ms]."""
Upload = Callable[[str, Sequence[Sample]], None]
"""Called with a device and its samples, on a thread that may wait; raises ``OSError`` or ``ValueError``."""

UPLOAD_PERIOD_S = 10.0
"""Period of uploads; each contains the samples of one device [s]."""
DEVICE_PERIOD_S = 60.0
"""Minimum time between two uploads for the same device [s]."""
SPACING_S = 1.0
"""Minimum time between two samples of a device: a message in a queue would measure the queue [s]."""
MAX_SAMPLES = 100
"""Samples of one device that wait for upload; older ones are dropped."""
_RESPONSE_S = 60.0
"""An upload that takes longer hangs [s]."""
_log = logging.getLogger(__name__)


class LatencyProbe:
    """A transport that measures the messages of another transport."""

    def __init__(self, transport: Transport, *, upload: Upload, at_ms: Callable[[], int]) -> None:
        self._transport = transport
        self._upload = upload
        self._at_ms = at_ms
        self._lock = threading.Lock()
        self._timed_s: dict[str, float] = {}
        self._samples: dict[str, deque[Sample]] = {}
        self._uploaded_s: dict[str, float] = {}
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name="latency-probe",
            part="upload of latencies",
            stopping=self._stopping,
            recovery=Recovery.RESTART,
            within_s=_RESPONSE_S,
        )

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
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> bool:
        """See ``Transport.publish``."""
        device = self._start_sample(topic) if qos else None
        if device is not None:
            delivered = partial(self._add_sample, device, time.monotonic(), delivered)
        return self._transport.publish(topic, payload, qos=qos, retain=retain, delivered=delivered)

    def stop(self) -> None:
        """See ``Transport.stop``. Waiting samples are dropped."""
        self._stopping.set()
        self._transport.stop()

    def _start_sample(self, topic: str) -> str | None:
        """The device of this message, if the message is to be measured."""
        parsed = topics.parse(topic)
        if parsed.kind != topics.STATE:  # others are acknowledged after storage, or sent in bulk
            return None
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._timed_s.get(parsed.device, -math.inf) < SPACING_S:
                return None
            self._timed_s[parsed.device] = now_s
        return parsed.device

    def _add_sample(self, device: str, sent_s: float, delivered: Callable[[], None] | None) -> None:
        ms = (time.monotonic() - sent_s) * 1000
        sample = (self._at_ms(), round(ms, 3))
        with self._lock:
            self._samples.setdefault(device, deque(maxlen=MAX_SAMPLES)).append(sample)
        if delivered is not None:
            delivered()

    # ------------------------------------------------------------ upload thread

    def _run(self) -> None:
        while not self._stopping.wait(UPLOAD_PERIOD_S):
            self._thread.beat()
            self._upload_one()

    def _upload_one(self) -> None:
        """Upload the samples of the device that has waited longest; a failed upload is dropped."""
        now_s = time.monotonic()
        with self._lock:
            uploaded_s = {name: self._uploaded_s.get(name, -math.inf) for name in self._samples}
            device = min(uploaded_s, key=uploaded_s.__getitem__, default=None)
            if device is None or now_s - uploaded_s[device] < DEVICE_PERIOD_S:
                return
            samples = tuple(self._samples.pop(device))
            self._uploaded_s[device] = now_s
        try:
            self._upload(device, samples)
        except (OSError, ValueError) as error:
            _log.info("%d latency samples of %s were not uploaded: %s", len(samples), device, error)
        except Exception:  # noqa: BLE001 (the thread continues with other samples)
            _log.exception("upload of latency samples of %s", device)

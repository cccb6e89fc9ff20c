"""What waits to be told over HTTP: gathered, so that one request carries what was said meanwhile."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from device_agent.protocol import topics

MEASURED_EVERY_S = 0.25
"""Measurements are gathered for so long: four requests a second carry them, whatever their rate."""
_OVERDUE_S = 4 * MEASURED_EVERY_S
_MOST_KEPT = 2000
_MOST_MEASURED = 500
_BATCH = 200
_BATCH_BYTES = 500_000
"""Half of what the cloud takes in one request: JSON around the payloads needs room too."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message to be told. ``kept``: not to be dropped while the link is up."""

    topic: str
    payload: bytes
    kept: bool
    delivered: Callable[[], None] | None = None

    @property
    def is_ack(self) -> bool:
        """Whether it answers a command."""
        return self.topic.endswith(f"/{topics.ACK}")


class SendQueue:
    """Two queues, each in order. Acks, state and events go first and at once; of measurements the newest win."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._kept: deque[Message] = deque()
        self._measured: deque[Message] = deque(maxlen=_MOST_MEASURED)
        self._told_s = 0.0
        self._closed = False

    def put(self, message: Message) -> bool:
        """Lay a message in; never blocks. Whether there was room: for a measurement there always is."""
        with self._changed:
            if not message.kept:
                self._measured.append(message)
            elif len(self._kept) < _MOST_KEPT:
                self._kept.append(message)
            else:
                return False
            # Whoever waits for the first measurement of a batch wakes by itself when the batch is due.
            if message.kept or len(self._measured) == 1:
                self._changed.notify()
        return True

    def put_back(self, batch: Sequence[Message]) -> None:
        """What could not be told now, before all that came since."""
        with self._changed:
            self._kept.extendleft(message for message in reversed(batch) if message.kept)
            for message in reversed(batch):
                if not message.kept and len(self._measured) < _MOST_MEASURED:
                    self._measured.appendleft(message)

    def clear(self) -> None:
        """The link is lost: whoever needs a message delivered says it again."""
        with self._changed:
            self._kept.clear()
            self._measured.clear()

    def close(self) -> None:
        """Nobody needs to wait any more."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def take(self, wait_s: float) -> list[Message]:
        """The next batch, or nothing after ``wait_s`` or when the tray was closed."""
        end_s = time.monotonic() + wait_s
        with self._changed:
            while not self._closed:
                now_s = time.monotonic()
                due_s = self._due_s()
                if due_s <= now_s:
                    break
                if now_s >= end_s:
                    return []
                self._changed.wait(min(due_s, end_s) - now_s)
            return self._batch(time.monotonic())

    def _due_s(self) -> float:
        if self._kept:
            return 0.0
        if len(self._measured) >= _BATCH:
            return 0.0
        return self._told_s + MEASURED_EVERY_S if self._measured else float("inf")

    def _batch(self, now_s: float) -> list[Message]:
        """Alone what must be told, for its sender waits; with measurements when they have had to wait for long."""
        batch = _cut(self._kept, _BATCH, _BATCH_BYTES)
        if not batch or now_s - self._told_s > _OVERDUE_S:
            size = sum(len(message.payload) for message in batch)
            batch += _cut(self._measured, _BATCH - len(batch), _BATCH_BYTES - size)
            self._told_s = now_s
        return batch


def _cut(waiting: deque[Message], most: int, most_bytes: int) -> list[Message]:
    batch: list[Message] = []
    size = 0
    while waiting and len(batch) < most:
        size += len(waiting[0].payload)
        if batch and size > most_bytes:
            break
        batch.append(waiting.popleft())
    return batch

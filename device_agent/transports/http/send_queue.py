"""Queue of messages to send over HTTP; combines messages into batches."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from device_agent.protocol import topics

MEASUREMENT_INTERVAL_S = 0.25
"""Interval of batches of measurements [s]: at most four requests per second, independent of their rate."""
_OVERDUE_S = 4 * MEASUREMENT_INTERVAL_S
_MAX_URGENT = 2000
_MAX_MEASUREMENTS = 500
_BATCH = 200
_BATCH_BYTES = 500_000
"""Half of the cloud's maximum request size, to leave room for the envelope [bytes]."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message to send. ``reliable``: never dropped while the link is up."""

    topic: str
    payload: bytes
    reliable: bool
    delivered: Callable[[], None] | None = None

    @property
    def is_ack(self) -> bool:
        """Whether the message acknowledges a command."""
        return self.topic.endswith(f"/{topics.ACK}")


class SendQueue:
    """Two ordered queues. Acks, state and events are sent first; of measurements only the newest remain queued."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._reliable: deque[Message] = deque()
        self._measured: deque[Message] = deque(maxlen=_MAX_MEASUREMENTS)
        self._sent_s = 0.0
        self._closed = False

    def put(self, message: Message) -> bool:
        """Add a message; never blocks. Returns False if the queue is full; measurements are always accepted."""
        with self._changed:
            if not message.reliable:
                self._measured.append(message)
            elif len(self._reliable) < _MAX_URGENT:
                self._reliable.append(message)
            else:
                return False
            # The sender's own timeout covers the next batch of measurements.
            if message.reliable or len(self._measured) == 1:
                self._changed.notify()
        return True

    def put_back(self, batch: Sequence[Message]) -> None:
        """Return messages that could not be sent, ahead of newer ones."""
        with self._changed:
            self._reliable.extendleft(message for message in reversed(batch) if message.reliable)
            for message in reversed(batch):
                if not message.reliable and len(self._measured) < _MAX_MEASUREMENTS:
                    self._measured.appendleft(message)

    def clear(self) -> None:
        """Drop all messages, because the link is lost; senders repeat messages that must be delivered."""
        with self._changed:
            self._reliable.clear()
            self._measured.clear()

    def close(self) -> None:
        """Wake and stop the sender."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def take(self, wait_s: float) -> list[Message]:
        """The next batch; empty after ``wait_s`` [s], or once the queue is closed."""
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
        if self._reliable:
            return 0.0
        if len(self._measured) >= _BATCH:
            return 0.0
        return self._sent_s + MEASUREMENT_INTERVAL_S if self._measured else float("inf")

    def _batch(self, now_s: float) -> list[Message]:
        """Urgent messages alone, since their senders wait; with measurements if those are overdue."""
        batch = _cut(self._reliable, _BATCH, _BATCH_BYTES)
        if not batch or now_s - self._sent_s > _OVERDUE_S:
            size = sum(len(message.payload) for message in batch)
            batch += _cut(self._measured, _BATCH - len(batch), _BATCH_BYTES - size)
            self._sent_s = now_s
        return batch


def _cut(queue: deque[Message], max_count: int, max_bytes: int) -> list[Message]:
    batch: list[Message] = []
    size = 0
    while queue and len(batch) < max_count:
        size += len(queue[0].payload)
        if batch and size > max_bytes:
            break
        batch.append(queue.popleft())
    return batch

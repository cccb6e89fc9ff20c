"""Acknowledged messages are sent first and alone; of measurements the newest remain."""

from types import SimpleNamespace

import pytest

from device_agent.protocol import topics
from device_agent.transports.http import send_queue
from device_agent.transports.http.send_queue import Message, SendQueue

TELE = topics.device("lab", "arm1", "arm", topics.TELE, "load")
EVENT = topics.device("lab", "arm1", "arm", topics.EVENT)
MEASUREMENT = Message(TELE, b"{}", reliable=False)


@pytest.fixture
def queue() -> SendQueue:
    return SendQueue()


def event(payload: bytes) -> Message:
    return Message(EVENT, payload, reliable=True)


def test_events_are_sent_before_measurements_and_alone(queue: SendQueue) -> None:
    queue.take(0)
    queue.put(MEASUREMENT)
    queue.take(1)
    queue.put(MEASUREMENT)
    queue.put(event(b"{}"))
    assert [message.topic for message in queue.take(0)] == [EVENT]
    assert [message.topic for message in queue.take(1)] == [TELE]


def test_the_newest_measurements_are_kept(queue: SendQueue) -> None:
    for number in range(2000):
        assert queue.put(Message(TELE, b"%d" % number, reliable=False))
    assert [int(message.payload) for _ in range(3) for message in queue.take(1)] == list(range(1500, 2000))


def test_constant_events_do_not_starve_measurements(queue: SendQueue, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr(send_queue, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    queue.put(MEASUREMENT)
    assert queue.take(0) == [MEASUREMENT]
    queue.put(MEASUREMENT)
    for _ in range(11):
        clock.now_s += send_queue.MEASUREMENT_INTERVAL_S
        queue.put(event(b"{}"))
        if MEASUREMENT in queue.take(0):
            break
    assert clock.now_s - 100.0 == 5 * send_queue.MEASUREMENT_INTERVAL_S


def test_a_batch_is_not_larger_than_the_cloud_accepts(queue: SendQueue) -> None:
    for _ in range(20):
        queue.put(event(b"x" * 120_000))
    sizes = []
    while batch := queue.take(0):
        sizes.append(sum(len(message.payload) for message in batch))
    assert sum(sizes) == 20 * 120_000
    assert max(sizes) <= 500_000


def test_returned_messages_are_sent_before_newer_ones(queue: SendQueue) -> None:
    events = [event(b"%d" % number) for number in range(4)]
    for each in events[:3]:
        queue.put(each)
    batch = queue.take(0)
    queue.put(events[3])
    queue.put_back(batch)
    assert queue.take(0) == events


def test_a_full_queue_rejects_events_until_a_batch_is_taken(queue: SendQueue) -> None:
    while queue.put(event(b"{}")):
        pass
    queue.take(0)
    assert queue.put(event(b"{}"))

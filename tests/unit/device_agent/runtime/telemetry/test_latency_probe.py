"""Latency probe: samples from acknowledged messages."""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest

from device_agent.ports.transport import LinkChanged, Receive
from device_agent.runtime.telemetry.latency_probe import MAX_SAMPLES, LatencyProbe, Sample
from tests.harness.agent.device_harness import eventually

STATE = "ts/v1/s/a/arm/state"
NOW_MS = 1_800_000_000_000


class Link:
    """A transport that acknowledges on request."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Callable[[], None] | None]] = []
        self.up = True
        self.stopped = 0

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        self.receive, self.link_changed = receive, link_changed

    def publish(self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Any = None) -> bool:
        assert (payload, retain) == (b"{}", qos == 1)
        if self.up:
            self.sent.append((topic, delivered))
        return self.up

    def stop(self) -> None:
        self.stopped += 1


class Timed:
    def __init__(self, **periods: float) -> None:
        self.link = Link()
        self.told: list[tuple[str, Sequence[Sample]]] = []
        self.trouble: list[Exception] = []
        self.link_was: list[bool] = []
        self.trips = LatencyProbe(self.link, upload=self.tell, at_ms=lambda: NOW_MS, **periods)
        self.trips.start(lambda _topic, _payload: None, self.link_was.append)

    def tell(self, device: str, samples: Sequence[Sample]) -> None:
        if self.trouble:
            raise self.trouble.pop()
        self.told.append((device, samples))

    def say(self, topic: str = STATE, *, qos: int = 1, **options: Any) -> bool:
        return self.trips.publish(topic, b"{}", qos=qos, retain=qos == 1, **options)

    def trip(self, topic: str = STATE) -> None:
        self.say(topic)
        delivered = self.link.sent[-1][1]
        assert delivered is not None
        delivered()


@pytest.fixture
def made() -> Iterator[Callable[..., Timed]]:
    all_of_them = []

    def make(**periods: float) -> Timed:
        all_of_them.append(Timed(**{"upload_period_s": 0.02, "device_period_s": 0.0, "spacing_s": 0.0, **periods}))
        return all_of_them[-1]

    yield make
    for timed in all_of_them:
        timed.trips.stop()
        assert timed.link.stopped == 1


def test_an_acknowledged_message_gives_a_sample_and_calls_the_sender(made: Callable[..., Timed]) -> None:
    timed, heard = made(), list[str]()
    assert timed.say(delivered=lambda: heard.append("delivered"))
    time.sleep(0.05)
    assert (heard, timed.told) == ([], [])
    confirm = timed.link.sent[0][1]
    assert confirm is not None
    confirm()
    ((device, ((at_ms, ms),)),) = eventually(lambda: timed.told)
    assert heard == ["delivered"]
    assert (device, at_ms) == ("arm", NOW_MS)
    assert 50 <= ms < 15_000


@pytest.mark.parametrize(
    ("topic", "qos"),
    [
        ("ts/v1/s/a/arm/tele/joints", 0),
        ("ts/v1/s/a/arm/late/joints", 1),
        ("ts/v1/s/a/arm/event", 1),
        ("ts/v1/s/a/arm/desc", 1),
    ],
)
def test_unacknowledged_and_bulk_messages_are_not_measured(made: Callable[..., Timed], topic: str, qos: int) -> None:
    timed = made()

    def mine() -> None:
        """The sender's own."""

    assert timed.say(topic, qos=qos, delivered=mine)
    assert timed.link.sent == [(topic, mine)]


def test_an_unsent_message_gives_no_sample(made: Callable[..., Timed]) -> None:
    timed = made()
    timed.link.up = False
    assert not timed.say()
    time.sleep(0.1)
    assert timed.told == []


def test_one_of_several_rapid_messages_per_device_is_measured(made: Callable[..., Timed]) -> None:
    timed = made(spacing_s=60.0)
    for _ in range(3):
        timed.say()
    timed.say("ts/v1/s/a/leg/ack")
    assert [delivered is not None for _, delivered in timed.link.sent] == [True, False, False, True]


def test_waiting_samples_are_bounded_and_the_newest_are_kept(made: Callable[..., Timed]) -> None:
    timed = made(upload_period_s=0.5)
    for _ in range(MAX_SAMPLES + 20):
        timed.trip()
    assert len(eventually(lambda: timed.told)[0][1]) == MAX_SAMPLES


def test_devices_are_uploaded_in_turn_at_a_limited_rate(made: Callable[..., Timed]) -> None:
    timed = made(device_period_s=60.0)
    timed.trip()
    timed.trip("ts/v1/s/a/leg/state")
    eventually(lambda: len(timed.told) == 2)
    assert {device for device, _ in timed.told} == {"arm", "leg"}
    timed.trip()
    time.sleep(0.2)
    assert len(timed.told) == 2


def test_a_lost_link_drops_samples(made: Callable[..., Timed]) -> None:
    timed = made(upload_period_s=0.3)
    timed.link.link_changed(True)
    timed.trip()
    timed.link.link_changed(False)
    time.sleep(0.5)
    assert timed.told == []
    assert timed.link_was == [True, False]


@pytest.mark.parametrize("trouble", [OSError("not reached"), ValueError("refused"), RuntimeError("a mistake")])
def test_a_failed_upload_is_dropped_and_the_next_continues(made: Callable[..., Timed], trouble: Exception) -> None:
    timed = made()
    timed.trouble.append(trouble)
    timed.trip()
    eventually(lambda: not timed.trouble)
    timed.trip("ts/v1/s/a/leg/state")
    eventually(lambda: timed.told)
    assert [device for device, _ in timed.told] == ["leg"]

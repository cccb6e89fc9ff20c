"""Latency probe: samples from acknowledged messages."""

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from device_agent.ports.transport import LinkChanged, Receive
from device_agent.runtime.telemetry import latency_probe as module
from device_agent.runtime.telemetry.latency_probe import MAX_SAMPLES, LatencyProbe, Sample
from tests.harness.agent.device_harness import eventually

ARM, LEG = "ts/v1/s/a/arm/state", "ts/v1/s/a/leg/state"
NOW_MS = 1_800_000_000_000


class ProbeFixture:
    """A probe on a manual clock, and its transport, which acknowledges on request."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.sent: list[tuple[str, Callable[[], None] | None]] = []
        self.up = True
        self.uploaded: list[tuple[str, Sequence[Sample]]] = []
        self.error: Exception | None = None
        self.link_changes: list[bool] = []
        self.probe = LatencyProbe(self, upload=self.upload, at_ms=lambda: NOW_MS)

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        self.receive, self.link_changed = receive, link_changed

    def publish(self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Any = None) -> bool:
        assert (payload, retain) == (b"{}", qos == 1)
        self.sent.append((topic, delivered))
        return self.up

    def stop(self) -> None:
        self.link_changes.append(False)

    def upload(self, device: str, samples: Sequence[Sample]) -> None:
        if self.error is not None:
            raise self.error
        self.uploaded.append((device, samples))

    def send(self, topic: str = ARM, *, qos: int = 1, **options: Any) -> Callable[[], None] | None:
        """Send a message; returns the function that acknowledges it."""
        assert self.probe.publish(topic, b"{}", qos=qos, retain=qos == 1, **options) == self.up
        return self.sent[-1][1]

    def sample(self, topic: str = ARM) -> None:
        self.now_s += 1.0
        acknowledge = self.send(topic)
        assert acknowledge is not None
        acknowledge()

    def upload_after(self, seconds: float) -> list[str]:
        """Devices of all uploads after this time."""
        self.now_s += seconds
        self.probe._upload_one()
        return [device for device, _ in self.uploaded]


@pytest.fixture
def fixture(monkeypatch: pytest.MonkeyPatch) -> ProbeFixture:
    return ProbeFixture(monkeypatch)


def test_an_acknowledged_message_gives_a_sample_and_calls_the_sender(fixture: ProbeFixture) -> None:
    calls: list[str] = []
    acknowledge = fixture.send(delivered=lambda: calls.append("delivered"))
    assert acknowledge is not None
    assert (fixture.upload_after(0.05), calls) == ([], [])
    acknowledge()
    fixture.upload_after(0.0)
    assert calls == ["delivered"]
    ((device, ((at_ms, ms),)),) = fixture.uploaded
    assert (device, at_ms) == ("arm", NOW_MS)
    assert ms == pytest.approx(50)


@pytest.mark.parametrize(
    ("kind", "qos"), [("tele/joints", 0), ("late/joints", 1), ("event", 1), ("ack", 1), ("desc", 1)]
)
def test_unacknowledged_and_bulk_messages_are_not_measured(fixture: ProbeFixture, kind: str, qos: int) -> None:
    def delivered() -> None: ...

    assert fixture.send(f"ts/v1/s/a/arm/{kind}", qos=qos, delivered=delivered) is delivered


def test_an_unsent_message_gives_no_sample(fixture: ProbeFixture) -> None:
    fixture.up = False
    fixture.send()
    assert fixture.upload_after(100.0) == []


def test_one_of_several_rapid_messages_per_device_is_measured(fixture: ProbeFixture) -> None:
    assert [fixture.send(topic) is not None for topic in (ARM, ARM, ARM, LEG)] == [True, False, False, True]


def test_waiting_samples_are_bounded_and_the_newest_are_kept(fixture: ProbeFixture) -> None:
    for _ in range(MAX_SAMPLES + 20):
        fixture.sample()
    fixture.upload_after(0.0)
    assert len(fixture.uploaded[0][1]) == MAX_SAMPLES


def test_devices_are_uploaded_in_turn_at_a_limited_rate(fixture: ProbeFixture) -> None:
    fixture.sample()
    fixture.sample(LEG)
    assert fixture.upload_after(0.0) == ["arm"]
    assert fixture.upload_after(10.0) == ["arm", "leg"]
    fixture.sample()
    assert fixture.upload_after(10.0) == ["arm", "leg"]
    assert fixture.upload_after(60.0) == ["arm", "leg", "arm"]


def test_the_thread_uploads_and_a_lost_link_drops_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    fixture = ProbeFixture(monkeypatch)
    monkeypatch.setattr(module, "UPLOAD_PERIOD_S", 0.01)
    fixture.sample(LEG)
    fixture.probe.start(lambda _topic, _payload: None, fixture.link_changes.append)
    eventually(lambda: fixture.uploaded)
    fixture.probe.stop()
    fixture.probe._thread.join()
    fixture.sample()
    fixture.link_changed(True)
    fixture.link_changed(False)
    assert fixture.upload_after(100.0) == ["leg"]
    assert fixture.link_changes == [False, True, False]


@pytest.mark.parametrize("error", [OSError("not reached"), ValueError("refused"), RuntimeError("a mistake")])
def test_a_failed_upload_is_dropped_and_the_next_continues(fixture: ProbeFixture, error: Exception) -> None:
    fixture.error = error
    fixture.sample()
    fixture.upload_after(0.0)
    fixture.error = None
    fixture.sample(LEG)
    assert fixture.upload_after(0.0) == ["leg"]
    assert fixture.upload_after(100.0) == ["leg"]

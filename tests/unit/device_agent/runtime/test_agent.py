"""Agent: routing of messages and link changes."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.ports.transport import LinkChanged, Receive
from device_agent.protocol import Measurements, Mode, Stop, codec, topics
from device_agent.runtime.agent import Agent
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.storage.outbox_store import OutboxStore
from device_agent.runtime.telemetry.outbox import Outbox
from tests.harness.agent.device_harness import DeviceHarness, eventually


class Link:
    """A link that the test controls."""

    def __init__(self, harness: DeviceHarness) -> None:
        self._harness = harness
        self.observed_first = False
        self.stopped = 0

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        self.observed_first = self._harness.device._loop.observation is not None
        self.receive, self.link_changed = receive, link_changed

    def publish(self, *_: Any, **__: Any) -> bool:
        return False

    def stop(self) -> None:
        self.stopped += 1


class AgentFixture:
    def __init__(self, folder: Path) -> None:
        self.harness = DeviceHarness(folder)
        self.link = Link(self.harness)
        self.readings = ReadingCache(space="s", agent="a", own=["arm"], named=[("other-pir", "presence")])
        store = OutboxStore(folder / "agent.db", own="ts/v1/s/a/", max_bytes=10**6, max_age_ms=3_600_000)
        self.agent = Agent(
            {"arm": self.harness.device},
            self.link,
            outbox=Outbox(store, publish=self.harness.publish, device_topic="ts/v1/s/a/arm"),
            readings=self.readings,
            address=("s", "a"),
        )


@pytest.fixture
def fixture(tmp_path: Path) -> Iterator[AgentFixture]:
    fixture = AgentFixture(tmp_path)
    fixture.agent.start()
    fixture.link.link_changed(True)
    yield fixture
    fixture.agent.stop()
    fixture.harness.outbox.stop()
    fixture.harness.journal.close()


def test_a_device_holds_before_the_link_starts_and_stop_is_idempotent(fixture: AgentFixture) -> None:
    assert fixture.link.observed_first
    assert fixture.agent.quiet
    fixture.agent.stop()
    fixture.agent.stop()
    assert fixture.link.stopped == 2


def test_only_messages_for_the_device_reach_it(fixture: AgentFixture) -> None:
    stop = codec.encode(Stop(id="s1"))
    for topic in ("ts/v1/s/a/leg/stop", "ts/v2/s/a/arm/stop", "$SYS", "", "ts/v1/x/y/arm/stop"):
        fixture.link.receive(topic, stop)
    assert fixture.harness.device._controller.latch is None
    fixture.link.receive("ts/v1/s/a/arm/stop", stop)
    eventually(lambda: fixture.harness.telemetry().mode is Mode.STOPPED)


def test_measurements_of_other_agents_are_cached(fixture: AgentFixture) -> None:
    measured = Measurements(tick_ms=1, at_ms=1, sequence=1, values={"present": True})
    fixture.link.receive(topics.device("s", "other", "pir", topics.TELE, "presence"), codec.encode(measured))
    reading = fixture.readings.latest("other-pir", "presence")
    assert reading is not None
    assert reading.values == {"present": True}


def test_a_lost_link_reaches_every_device(fixture: AgentFixture) -> None:
    running = fixture.harness.running(fixture.harness.script("wait(600)"), epoch=1)
    assert not fixture.agent.quiet
    fixture.link.link_changed(False)
    assert fixture.harness.end_code(running) == "link_lost"

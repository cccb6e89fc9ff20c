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
def whole(tmp_path: Path) -> Iterator[AgentFixture]:
    whole = AgentFixture(tmp_path)
    whole.agent.start()
    whole.link.link_changed(True)
    yield whole
    whole.agent.stop()
    whole.harness.outbox.stop()
    whole.harness.journal.close()


def test_a_device_holds_before_the_link_starts_and_stop_is_idempotent(whole: AgentFixture) -> None:
    assert whole.link.observed_first
    assert whole.agent.quiet
    whole.agent.stop()
    whole.agent.stop()
    assert whole.link.stopped == 2


def test_only_messages_for_the_device_reach_it(whole: AgentFixture) -> None:
    stop = codec.encode(Stop(id="s1", caller="bob"))
    for topic in ("ts/v1/s/a/leg/stop", "ts/v2/s/a/arm/stop", "$SYS", "", "ts/v1/x/y/arm/stop"):
        whole.link.receive(topic, stop)
    assert whole.harness.device._controller.latch is None
    whole.link.receive("ts/v1/s/a/arm/stop", stop)
    eventually(lambda: whole.harness.telemetry().mode is Mode.STOPPED)


def test_measurements_of_other_agents_are_cached(whole: AgentFixture) -> None:
    measured = Measurements(tick_ms=1, at_ms=1, sequence=1, values={"present": True})
    whole.link.receive(topics.device("s", "other", "pir", topics.TELE, "presence"), codec.encode(measured))
    reading = whole.readings.latest("other-pir", "presence")
    assert reading is not None
    assert reading.values == {"present": True}


def test_a_lost_link_reaches_every_device(whole: AgentFixture) -> None:
    running = whole.harness.running(whole.harness.script("wait(600)"), epoch=1)
    assert not whole.agent.quiet
    whole.link.link_changed(False)
    assert whole.harness.end_code(running) == "link_lost"

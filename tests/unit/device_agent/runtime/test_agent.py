"""Agent: routing of messages and link changes."""

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


class ToyLink:
    """A link that the test moves by hand."""

    def __init__(self, harness: DeviceHarness) -> None:
        self._bench = harness
        self.held_first = False
        self.stopped = 0

    def start(self, receive: Receive, link_changed: LinkChanged) -> None:
        self.held_first = self._bench.device._loop.observation is not None
        self.receive, self.link_changed = receive, link_changed

    def publish(self, *_: Any, **__: Any) -> bool:
        return False

    def stop(self) -> None:
        self.stopped += 1


class Whole:
    def __init__(self, harness: DeviceHarness, folder: Path) -> None:
        self.harness = harness
        self.link = ToyLink(harness)
        self.room = ReadingCache(space="s", agent="a", own=["arm"], named=[("other-pir", "presence")])
        store = OutboxStore(folder / "whole.db", own="ts/v1/s/a/", max_bytes=10**6, max_age_ms=3_600_000)
        self.outbox = Outbox(store, publish=harness.publish, device_topic="ts/v1/s/a/arm")
        self.agent = Agent(
            {"arm": harness.device}, self.link, outbox=self.outbox, readings=self.room, address=("s", "a")
        )


@pytest.fixture
def whole(tmp_path: Path):
    whole = Whole(DeviceHarness(tmp_path), tmp_path)
    whole.agent.start()
    whole.link.link_changed(True)
    yield whole
    whole.agent.stop()
    whole.harness.outbox.stop()
    whole.harness.journal.close()


def test_a_device_holds_before_the_link_starts(whole: Whole) -> None:
    assert whole.link.held_first
    assert whole.agent.quiet


def test_messages_reach_their_device(whole: Whole) -> None:
    whole.link.receive("ts/v1/s/a/arm/stop", codec.encode(Stop(id="s1", caller="bob")))
    eventually(lambda: whole.harness.telemetry().mode is Mode.STOPPED)


@pytest.mark.parametrize("topic", ["ts/v1/s/a/leg/stop", "ts/v2/s/a/arm/stop", "$SYS", "", "ts/v1/x/y/arm/stop"])
def test_foreign_topics_are_ignored(whole: Whole, topic: str) -> None:
    whole.link.receive(topic, codec.encode(Stop(id="s1", caller="bob")))
    assert whole.harness.telemetry().mode is Mode.IDLE


def test_measurements_of_other_agents_are_cached(whole: Whole) -> None:
    measured = Measurements(tick_ms=1, at_ms=1, sequence=1, values={"present": True})
    topic = topics.device("s", "other", "pir", topics.TELE, "presence")
    whole.link.receive(topic, codec.encode(measured))
    reading = whole.room.latest("other-pir", "presence")
    assert reading is not None
    assert reading.values == {"present": True}


def test_a_lost_link_reaches_every_device(whole: Whole) -> None:
    running = whole.harness.command(whole.harness.script("wait(600)"), epoch=1)
    eventually(lambda: whole.harness.acks(running)[1:])
    assert not whole.agent.quiet
    whole.link.link_changed(False)
    reason = whole.harness.end(running).reason
    assert reason is not None
    assert reason.code == "link_lost"


def test_stop_is_idempotent(whole: Whole) -> None:
    whole.agent.stop()
    whole.agent.stop()
    assert whole.link.stopped == 2

"""A hostile broker moves nothing and forges no author; see ``hostile_broker``."""

import logging
import unicodedata
from pathlib import Path

import pytest

from device_agent.protocol import Ack, AckStatus, Event, StopLatch, topics
from device_agent.protocol.events import EventKind
from tests.harness.agent.device_harness import eventually, wait_for_state
from tests.security.broker.hostile_broker import AttackedDevice, HostileBroker, agent_of

FULL_SIZE = 100_000
SAMPLE_SIZE = 2_000


def attack(folder: Path, messages: int, caplog: pytest.LogCaptureFixture, seed: int = 7) -> None:
    victim = AttackedDevice(folder)
    victim.start()
    broker = HostileBroker(victim, agent_of(victim), seed)
    try:
        with caplog.at_level(logging.INFO):
            broker.run(messages)
            broker.stop(10)
            shown = wait_for_state(victim, lambda state: state.stop).stop
        eventually(victim.device._commands._commands.empty)
    finally:
        victim.stop()
    assert broker.delivered >= messages
    assert victim.watched.forged_rad == 0.0
    order = [(each.epoch, each.sequence) for each in victim.accepted]
    assert order == sorted(set(order)), "no setpoint is applied twice or after a newer one"
    assert [each for each in victim.accepted if each not in victim.sent] == []
    inputs = [(each.epoch, each.input) for each in victim.accepted]
    assert inputs == sorted(inputs), "no ended input applies again"
    assert len(victim.accepted) > len(victim.sent) / 4, "the attack does not stop the honest operator"
    started = [ack.id for ack in victim.published(topics.ACK, Ack) if ack.status is AckStatus.STARTED]
    assert len(started) == len(set(started)) > 0
    assert not [each for each in started if each.startswith("h")]
    assert_no_forged_author(victim, [latch for latch in (*broker.latches, shown) if latch is not None])
    assert not [text for text in caplog.messages if any(unicodedata.category(each) in {"Cc", "Cf"} for each in text)]


def assert_no_forged_author(victim: AttackedDevice, latches: list[StopLatch]) -> None:
    """No signed Stop was sent, so that no author is verified."""
    assert len(latches) > 1
    assert [each for each in latches if each.verified or not each.caller.endswith(" (unverified)")] == []
    events = [*victim.events(EventKind.STOP_LATCHED), *victim.events(EventKind.STOP_VERIFIED)]
    assert [each for each in events if each.data["verified"] or not each.data["caller"].endswith("(unverified)")] == []
    texts = [text for each in victim.published(topics.EVENT, Event) for text in (each.message, *each.data.values())]
    assert not [text for text in texts if isinstance(text, str) and not text.isprintable()]


def test_a_hostile_broker_moves_nothing_and_forges_no_author(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    attack(tmp_path, SAMPLE_SIZE, caplog)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_hundred_thousand_messages_of_a_hostile_broker(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    attack(tmp_path, FULL_SIZE, caplog)

"""Broker and agent are killed one after the other: no event is lost and no command runs twice."""

import contextlib
import sqlite3
from itertools import pairwise
from pathlib import Path

from device_agent.ports.clock import wall_ms
from device_agent.protocol import AckStatus, GrantLease, JointTelemetry, MoveJoints, topics
from device_agent.protocol.events import EventKind
from tests.harness.agent.custom_agent import AgentProcess
from tests.harness.network.brokers import start_broker, wait_until

TOML = """
[buffer]
measurements_hz = 5

[[devices]]
name = "arm"
type = "ur5"
"""
MAX_GAP = 30
"""Every fourth measurement is stored; the rest is tolerance for a busy machine."""


def stored(agent: AgentProcess, *, late: bool) -> list[bytes]:
    """Messages in the outbox on disk."""
    with contextlib.closing(sqlite3.connect(agent.store.outbox, timeout=20)) as database:
        rows = database.execute("SELECT payload FROM items WHERE late = ? ORDER BY id", (late,)).fetchall()
    return [payload for (payload,) in rows]


def has_stored_event(agent: AgentProcess, kind: EventKind) -> bool:
    return any(f'"{kind}"'.encode() in payload for payload in stored(agent, late=False))


def test_messages_are_sent_later_after_broker_and_agent_were_killed(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(start_broker("mosquitto", tmp_path / "broker"))
        agent = stack.enter_context(AgentProcess(tmp_path / "store", broker, TOML))
        agent.start()
        agent.ready()
        agent.execute(GrantLease(holder="ann", lease_ms=60_000), epoch=3)
        done = agent.command(MoveJoints(position_rad={"shoulder_pan": 0.1}, speed=0.5), epoch=3)
        assert agent.final_ack(done).status is AckStatus.DONE
        running = agent.move(6.0, epoch=3, speed=0.05)
        # Acknowledged messages that the broker has not forwarded yet are lost with it; this is not tested here.
        wait_until(lambda: agent.events(EventKind.AGENT_STARTED), "the first start to be reported")

        broker.kill()
        wait_until(lambda: has_stored_event(agent, EventKind.MOTION_HELD), "the hold on disk")
        wait_until(lambda: len(stored(agent, late=True)) > 5, "measurements on disk")
        agent.kill()
        killed_ms = wall_ms()
        count = len(stored(agent, late=True))
        agent.start()
        wait_until(lambda: has_stored_event(agent, EventKind.AGENT_STARTED), "the second start on disk")
        wait_until(lambda: len(stored(agent, late=True)) > count, "its measurements on disk")

        on_disk = stored(agent, late=True)
        agent.client.close()
        again = stack.enter_context(start_broker("mosquitto", tmp_path / "broker", tcp_port=broker.tcp_port))
        back_ms = wall_ms()
        agent.use_broker(again)
        agent.ready()
        wait_until(lambda: not stored(agent, late=False) and not stored(agent, late=True), "an empty outbox")

        (held,) = agent.events(EventKind.MOTION_HELD)
        assert held.data["code"] == "link_lost"
        assert held.at_ms < killed_ms
        assert len(agent.events(EventKind.AGENT_STARTED)) == 2
        assert agent.final_ack(running).status is AckStatus.FAILED
        require_complete_measurements(agent, on_disk, killed_ms, back_ms)
        require_no_repetition(agent, done)


def require_complete_measurements(agent: AgentProcess, on_disk: list[bytes], killed_ms: int, back_ms: int) -> None:
    late = agent.received(topics.LATE, JointTelemetry, topics.JOINTS)
    # In any order: the broker loses what it receives before the subscription of the test, and the agent repeats it.
    assert set(on_disk) <= {payload for topic, payload in agent.messages if f"/{topics.LATE}/" in topic}
    numbers = sorted({each.sequence for each in (*late, *agent.telemetry()) if each.at_ms < killed_ms})
    assert max(after - before for before, after in pairwise(numbers)) < MAX_GAP, "while only the broker was down"
    assert any(killed_ms < each.at_ms < back_ms for each in late), "after the second start"


def require_no_repetition(agent: AgentProcess, done: str) -> None:
    state = agent.state()
    assert (state.epoch, state.ended_epoch) == (3, 3)
    count = len(agent.telemetry())
    agent.command(MoveJoints(position_rad={"shoulder_pan": 1.0}), epoch=3, command_id=done)
    stale = agent.execute(GrantLease(holder="bert", lease_ms=60_000), epoch=2).reason
    assert stale is not None
    assert stale.code == "stale_epoch"
    assert agent.final_ack(done).status is AckStatus.DONE
    assert max(agent.speeds(since=count), default=0.0) == 0

"""A broker that dies and an agent that dies while it is away: nothing that happened is lost, nothing is done twice."""

import contextlib
import sqlite3
from itertools import pairwise
from pathlib import Path

from device_agent.ports.clock import wall_ms
from device_agent.protocol import AckStatus, GrantLease, JointTelemetry, MoveJoints, StopDevice, topics
from device_agent.protocol.events import EventKind
from tests.harness.agent.custom_agent import OwnAgent
from tests.harness.network.brokers import start_broker, wait_until

TOML = """
[buffer]
measurements_hz = 5
settle_s = 0.5

[[devices]]
name = "arm"
type = "ur5"
"""
GAP = 30
"""Every fourth measurement is kept; the rest is for a machine that has other things to do. Counted, not timed: what was
not measured left no hole."""


def kept(agent: OwnAgent, *, late: bool) -> list[bytes]:
    """What lies in the outbox on disk."""
    with contextlib.closing(sqlite3.connect(agent.store.outbox, timeout=20)) as database:
        rows = database.execute("SELECT payload FROM items WHERE late = ? ORDER BY id", (late,)).fetchall()
    return [row[0] for row in rows]


def kept_event(agent: OwnAgent, kind: EventKind) -> bool:
    return any(f'"{kind}"'.encode() in payload for payload in kept(agent, late=False))


def test_what_happened_while_the_broker_and_then_the_agent_were_dead_is_told_later(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        broker = stack.enter_context(start_broker("mosquitto", tmp_path / "broker"))
        agent = stack.enter_context(OwnAgent(tmp_path / "store", broker, TOML))
        agent.start()
        agent.ready()
        agent.obey(GrantLease(holder="ann", lease_ms=60_000), epoch=3)
        done = agent.command(MoveJoints(position_rad={"shoulder_pan": 0.1}, speed=0.5), epoch=3)
        assert agent.ended(done).status is AckStatus.DONE
        under_way = agent.move(6.0, epoch=3, speed=0.05)
        # What a broker has confirmed and not yet passed on dies with it: that is not what is asked here.
        wait_until(lambda: agent.events(EventKind.AGENT_STARTED), "its first life to be told")

        broker.kill()
        wait_until(lambda: kept_event(agent, EventKind.MOTION_HELD), "the hold, on disk")
        wait_until(lambda: len(kept(agent, late=True)) > 5, "measurements on disk")
        agent.kill()
        died_ms = wall_ms()
        before = len(kept(agent, late=True))
        agent.start()
        wait_until(lambda: kept_event(agent, EventKind.AGENT_STARTED), "the next life, on disk")
        wait_until(lambda: len(kept(agent, late=True)) > before, "its measurements on disk")

        agent.line.close()
        again = stack.enter_context(start_broker("mosquitto", tmp_path / "broker", tcp_port=broker.tcp_port))
        back_ms = wall_ms()
        agent.use(again)
        agent.ready()
        wait_until(lambda: not kept(agent, late=False) and not kept(agent, late=True), "all of it to be told")

        (held,) = agent.events(EventKind.MOTION_HELD)
        assert held.data["code"] == "link_lost"
        assert held.at_ms < died_ms
        assert len(agent.events(EventKind.AGENT_STARTED)) == 2
        assert agent.ended(under_way).status is AckStatus.FAILED
        no_hole(agent, died_ms, back_ms)
        nothing_is_done_again(agent, done)
        a_latched_stop_outlives_a_kill(agent)


def no_hole(agent: OwnAgent, died_ms: int, back_ms: int) -> None:
    told = agent.told(topics.LATE, JointTelemetry, topics.JOINTS)
    late = [each.at_ms for each in told]
    assert late == sorted(late), "in order"
    known = sorted({each.sequence for each in (*told, *agent.telemetry()) if each.at_ms < died_ms})
    assert max(after - before for before, after in pairwise(known)) < GAP, "while only the broker was dead"
    assert any(died_ms < at_ms < back_ms for at_ms in late), "and in the life after"


def nothing_is_done_again(agent: OwnAgent, done: str) -> None:
    state = agent.state()
    assert (state.epoch, state.ended_epoch) == (3, 3)
    before = len(agent.telemetry())
    agent.command(MoveJoints(position_rad={"shoulder_pan": 1.0}), epoch=3, command_id=done)
    stale = agent.obey(GrantLease(holder="bert", lease_ms=60_000), epoch=2)
    assert stale.reason is not None
    assert stale.reason.code == "stale_epoch"
    assert agent.ended(done).status is AckStatus.DONE
    assert max(agent.speeds(since=before), default=0.0) == 0


def a_latched_stop_outlives_a_kill(agent: OwnAgent) -> None:
    identity = (agent.store.folder / "identity.pem").read_bytes()
    agent.obey(StopDevice(reason="smoke"))
    agent.kill()
    agent.start()
    wait_until(lambda: len(agent.events(EventKind.AGENT_STARTED)) == 3, "the third life")
    assert agent.state().stop is not None
    agent.obey(GrantLease(holder="ann", lease_ms=60_000), epoch=4)
    refused = agent.obey(MoveJoints(position_rad={"shoulder_pan": 1.0}), epoch=4)
    assert refused.reason is not None
    assert refused.reason.code == "stopped"
    assert (agent.store.folder / "identity.pem").read_bytes() == identity

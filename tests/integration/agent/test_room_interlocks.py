"""Over a real broker a sensor of the room slows and holds a moving arm, and so does its silence."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.protocol import AckStatus
from device_agent.protocol.events import EventKind
from tests.harness.agent.custom_agent import OwnAgent, Sensor
from tests.harness.network.brokers import RunningBroker, start_broker, wait_until

STALE_S = 2.5
SLOW = 0.2
TOML = f"""
[buffer]
settle_s = 0.5

[[devices]]
name = "arm"
type = "ur5"

[[devices.interlocks]]
device = "sensors-zone"
stream = "presence"
field = "distance_m"
below = 2
action = "slow"
speed = {SLOW}
stale_s = {STALE_S}

[[devices.interlocks]]
device = "sensors-zone"
stream = "presence"
field = "distance_m"
below = 1
stale_s = {STALE_S}
"""
FREE, NEAR, TOO_NEAR = 5.0, 1.5, 0.5
FULL_RAD_S = 0.3 * 3.14


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[RunningBroker]:
    with start_broker("amqtt", tmp_path / "broker") as broker:
        yield broker


def acted(agent: OwnAgent) -> list[str]:
    return [event.data["reason"] for event in agent.events(EventKind.INTERLOCK_ENGAGED)]


def restrictions(agent: OwnAgent) -> dict[str, float]:
    return {each.source.rpartition(" < ")[2]: each.speed for each in agent.state().restrictions}


def test_presence_slows_then_holds_and_silence_holds(broker: RunningBroker, tmp_path: Path) -> None:
    with OwnAgent(tmp_path / "home", broker, TOML) as agent:
        agent.start()
        agent.ready()
        wait_until(lambda: restrictions(agent) == {"2": SLOW, "1": 0.0}, "the holds of a room that is not known yet")
        with Sensor(broker, "sensors", "zone", "presence", distance_m=FREE) as sensor:
            wait_until(lambda: restrictions(agent) == {}, "a free room")

            first = agent.move(6.0, epoch=1)
            wait_until(lambda: agent.speeds()[-1] > 0.8 * FULL_RAD_S, "full speed")
            sensor.values = {"distance_m": NEAR}
            wait_until(lambda: agent.speeds()[-1] < 1.1 * SLOW * FULL_RAD_S, "the slow-down")
            assert min(agent.speeds()[-3:]) > 0, "slowed, not held"

            sensor.values = {"distance_m": TOO_NEAR}
            wait_until(lambda: agent.speeds()[-1] == 0, "the hold")
            ack = agent.ended(first)
            assert (ack.status, ack.reason and ack.reason.code) == (AckStatus.FAILED, "interlock")
            wait_until(lambda: restrictions(agent).get("1") == 0.0, "the hold to be shown")

            sensor.values = {"distance_m": FREE}
            wait_until(lambda: restrictions(agent) == {}, "a free room again")
            rested = len(agent.telemetry())
            wait_until(lambda: len(agent.telemetry()) > rested + 20, "a while")
            assert max(agent.speeds(since=rested)) == 0, "nothing resumes by itself"

            second = agent.move(-6.0, epoch=2)
            sensor.values = None
            silent_s = time.monotonic()
            ack = agent.ended(second)
            assert (ack.status, ack.reason and ack.reason.code) == (AckStatus.FAILED, "interlock")
            assert time.monotonic() - silent_s >= STALE_S - 0.5, "not before it was stale"
            wait_until(lambda: agent.speeds()[-1] == 0, "the hold for silence")
        told = ("no measurement of", "distance_m < 2", "distance_m < 1", "is silent")
        wait_until(lambda: all(any(why in each for each in acted(agent)) for why in told), "events that say each of it")
        wait_until(lambda: agent.events(EventKind.INTERLOCK_CLEARED), "one that says that the room is free")

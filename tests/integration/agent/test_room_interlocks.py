"""Measurements of a room sensor, and their absence, slow and hold a moving arm over a real broker."""

import time
from pathlib import Path

from device_agent.protocol import AckStatus
from device_agent.protocol.events import EventKind
from tests.harness.agent.custom_agent import AgentProcess, Sensor
from tests.harness.network.brokers import start_broker, wait_until

STALE_S = 2.5
SLOW = 0.2
TOML = f"""
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


def reasons(agent: AgentProcess) -> list[str]:
    return [event.data["reason"] for event in agent.events(EventKind.INTERLOCK_ENGAGED)]


def restrictions(agent: AgentProcess) -> dict[str, float]:
    return {each.source.rpartition(" < ")[2]: each.speed for each in agent.state().restrictions}


def end(agent: AgentProcess, action: str) -> tuple[AckStatus, str]:
    ack = agent.final_ack(action)
    return ack.status, "" if ack.reason is None else ack.reason.code


def test_presence_slows_then_holds_and_silence_holds(tmp_path: Path) -> None:
    failed = (AckStatus.FAILED, "interlock")
    with start_broker("amqtt", tmp_path / "broker") as broker, AgentProcess(tmp_path / "home", broker, TOML) as agent:
        agent.start()
        agent.ready()
        wait_until(lambda: restrictions(agent) == {"2": SLOW, "1": 0.0}, "holds without measurements")
        with Sensor(broker, "sensors", "zone", "presence", distance_m=FREE) as sensor:
            wait_until(lambda: restrictions(agent) == {}, "a free room")

            first = agent.move(6.0, epoch=1)
            wait_until(lambda: agent.speeds()[-1] > 0.8 * FULL_RAD_S, "full speed")
            sensor.values = {"distance_m": NEAR}
            wait_until(lambda: agent.speeds()[-1] < 1.1 * SLOW * FULL_RAD_S, "the slow-down")
            assert min(agent.speeds()[-3:]) > 0, "slowed, not held"

            sensor.values = {"distance_m": TOO_NEAR}
            wait_until(lambda: agent.speeds()[-1] == 0, "the hold")
            assert end(agent, first) == failed
            wait_until(lambda: restrictions(agent).get("1") == 0.0, "the restriction in the state")

            sensor.values = {"distance_m": FREE}
            wait_until(lambda: restrictions(agent) == {}, "a free room again")
            count = len(agent.telemetry())
            wait_until(lambda: len(agent.telemetry()) > count + 20, "more telemetry")
            assert max(agent.speeds(since=count)) == 0, "the motion must not resume automatically"

            second = agent.move(-6.0, epoch=2)
            sensor.values = None
            silent_s = time.monotonic()
            assert end(agent, second) == failed
            assert time.monotonic() - silent_s >= STALE_S - 0.5, "the arm held before the measurement was stale"
            wait_until(lambda: agent.speeds()[-1] == 0, "the hold without measurements")
        expected = ("no measurement of", "distance_m < 2", "distance_m < 1", "is silent")
        wait_until(lambda: all(any(text in each for each in reasons(agent)) for text in expected), "events")
        wait_until(lambda: agent.events(EventKind.INTERLOCK_CLEARED), "the event of a free room")

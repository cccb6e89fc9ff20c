"""Arms without physics for measurements of the page: the product's own arm supplies description and drawing.

Ten physics simulations on the same small machine would take the processor time that the page needs.
"""

import contextlib
import itertools
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import msgspec

from benchmarks.console.minimal_agents import pair_minimal_agents
from device_agent.ports.clock import tick_ms, wall_ms
from device_agent.protocol import Description, JointTelemetry, Mode, State, Twin, codec, topics
from function_app.ports.broker_access import Credentials
from tests.fakes.agent import Robot
from tests.harness.browser.product import Machine
from tests.harness.network.brokers import Client, wait_until

RATE_HZ: Final = 20.0
SWING_S: Final = 9.0
SIDE_RAD: Final = 0.9
PAN: Final = 0
"""Index of the joint that swings."""
ARMS_PER_AGENT: Final = 5
STATE_EVERY_S: Final = 10.0


@dataclass(frozen=True)
class _Pattern:
    """Description and drawing of one arm."""

    description: Description
    twin: Twin
    joints: JointTelemetry


@contextlib.contextmanager
def start_kinematic_arms(machine: Machine, count: int) -> Iterator[list[str]]:
    """Runs arms of the demo account with telemetry at ``RATE_HZ`` and yields their device ids."""
    stopping = threading.Event()
    with pair_minimal_agents(machine, count, ARMS_PER_AGENT) as robots:
        pattern = _pattern(machine)
        arms = [(robot, name) for robot in robots for name in robot.names]
        for robot, name in arms:
            _publish_description(robot, name, pattern)
        thread = threading.Thread(target=_swing, args=(arms, pattern, stopping))
        thread.start()
        try:
            yield [device for robot in robots for device in robot.devices]
        finally:
            stopping.set()
            thread.join()


def _pattern(machine: Machine) -> _Pattern:
    """Reads description and drawing of the product's own arm."""
    with machine.api() as api:
        topic = api.device()["topic"]
        issued = api.post("/mqtt/credentials", {"purpose": "view"})
    login = Credentials(issued["username"], issued["password"])
    with Client(issued["client_id"], login, port=issued["tcp"]["port"]).open() as client:
        filters = [f"{topic}/{kind}" for kind in ("desc", "desc/twin", "tele/joints")]
        client.subscribe(*filters)
        payloads: dict[str, bytes] = {}

        def complete() -> bool:
            payloads.update({message.topic: message.payload for message in client.pending()})
            return payloads.keys() >= set(filters)

        wait_until(complete, "the description of the arm")
    description, twin, joints = (payloads[each] for each in filters)
    return _Pattern(
        codec.decode(description, Description), codec.decode(twin, Twin), codec.decode(joints, JointTelemetry)
    )


def _publish_description(robot: Robot, name: str, pattern: _Pattern) -> None:
    def publish(kind: str, message: msgspec.Struct, suffix: str = "") -> None:
        topic = topics.device(robot.space, robot.id, name, kind, suffix)
        robot.publish(topic, msgspec.structs.replace(message, device=name), retain=True)

    publish(topics.DESC, pattern.description)
    publish(topics.DESC, pattern.twin, topics.TWIN)
    _publish_state(robot, name)


def _publish_state(robot: Robot, name: str) -> None:
    state = State(device=name, at_ms=wall_ms(), tick_ms=tick_ms(), mode=Mode.IDLE, epoch=0)
    robot.publish(topics.device(robot.space, robot.id, name, topics.STATE), state, retain=True)


def _swing(arms: list[tuple[Robot, str]], pattern: _Pattern, stopping: threading.Event) -> None:
    """Publishes positions until the end; each arm lags slightly behind the previous one."""
    next_s = started_s = time.monotonic()
    for sequence in itertools.count(1):
        for index, (robot, name) in enumerate(arms):
            phase = 2 * math.pi * (time.monotonic() - started_s) / SWING_S - index
            telemetry = _at(pattern.joints, SIDE_RAD * math.sin(phase), sequence)
            topic = topics.device(robot.space, robot.id, name, topics.TELE, topics.JOINTS)
            if robot.link is not None:
                robot.link.publish(topic, codec.encode(telemetry), qos=0)
        next_s = max(next_s + 1 / RATE_HZ, time.monotonic())
        if stopping.wait(next_s - time.monotonic()):
            return


def _at(pattern: JointTelemetry, pan_rad: float, sequence: int) -> JointTelemetry:
    position = tuple(value + (pan_rad if index == PAN else 0.0) for index, value in enumerate(pattern.position_rad))
    return msgspec.structs.replace(
        pattern, tick_ms=tick_ms(), at_ms=wall_ms(), sequence=sequence, position_rad=position, commanded_rad=position
    )

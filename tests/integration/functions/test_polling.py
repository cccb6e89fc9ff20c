"""An agent that speaks nothing but HTTP does all that one on MQTT does."""

import time
from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.protocol import codec, topics
from device_agent.protocol.messages import (
    AckStatus,
    Mode,
    RunMovement,
    State,
)
from function_app.services import store
from tests.support.brokers import wait_until
from tests.support.cloud import Cloud, Person, problem
from tests.support.polling import PollingRobot

BOTH = pytest.mark.parametrize("wait_ms", [0, 500], ids=["plain", "long"])
WAVE = {"kind": "run_movement", "name": "mine", "parameters": {"note": 'grüß 🤖 " \\ \n'}}


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@pytest.fixture
def robot(cloud: Cloud, anna: Person) -> Iterator[PollingRobot]:
    """Paired, and not yet asking."""
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        yield robot


def items(robot: PollingRobot, **query: Any) -> list[dict[str, Any]]:
    answer = robot.poll(**query)
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()["items"]
    return found


def obey(robot: PollingRobot, found: list[dict[str, Any]]) -> None:
    """Take commands as if they had come by themselves; tells nothing."""
    from tests.support.brokers import Message

    for item in found:
        robot.obey(Message(item["topic"], item["payload"].encode(), 1, retain=False))


def mailbox(cloud: Cloud, robot: PollingRobot) -> list[str]:
    page = cloud.run(cloud.functions.tables.query(store.MAILBOX, robot.id, limit=1000))
    return [row.key for row in page.rows]


def state(tick_ms: int = 1) -> State:
    return State(device="arm", at_ms=1, tick_ms=tick_ms, mode=Mode.IDLE, epoch=0)


class TestAllThatMqttDoes:
    @BOTH
    def test_lease_action_end_stop_and_reset(
        self, cloud: Cloud, anna: Person, robot: PollingRobot, wait_ms: int
    ) -> None:
        robot.wait_ms = wait_ms
        robot.connect()
        assert anna.get(f"/devices/{robot.device}").json()["online"]
        anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"})
        lease = anna.take(robot.device, wait_ms=10_000).json()
        assert lease["confirmed"]
        action = anna.start(robot.device, request=WAVE, epoch=lease["epoch"], wait_ms=10_000).json()
        assert action["status"] == "started"
        (command,) = robot.heard(RunMovement)
        assert isinstance(command.request, RunMovement)
        assert command.request.parameters == WAVE["parameters"]
        problem(anna.start(robot.device, epoch=lease["epoch"]), 409, "device-busy")
        robot.report(action["id"], AckStatus.DONE, result={"reached": True})
        final = anna.action(action["id"], wait_ms=10_000, wait_for="done")
        assert (final["status"], final["result"]) == ("done", {"reached": True})
        assert anna.post(f"/devices/{robot.device}/stop", {"reason": "look out"}).json() == {"confirmed": True}
        assert anna.post(f"/devices/{robot.device}/stop/reset").json() == {"confirmed": True}
        assert [command.id for command in robot.commands] == list(robot.payloads)
        wait_until(lambda: not [key for key in mailbox(cloud, robot) if not key.startswith("ack:")], "an empty mailbox")

    def test_a_device_that_says_no_confirms_nothing(self, anna: Person, robot: PollingRobot) -> None:
        asking = anna.begin("POST", f"/devices/{robot.device}/lease", json={"wait_ms": 10_000})
        (item,) = items(robot, wait_ms=10_000)
        ack = robot.ack(item["id"], AckStatus.FAILED)
        robot.tell_raw((robot.topic(topics.ACK), codec.encode(ack)))
        started = time.monotonic()
        assert asking().json()["confirmed"] is False
        assert time.monotonic() - started < 8, "an answer that says no is an answer"

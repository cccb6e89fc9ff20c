"""An operator loses access when a share ends, even while streaming setpoints and starting actions."""

import logging
import random
import statistics
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import pytest

from device_agent.protocol import GrantLease, MoveJoints, ReleaseLease, topics
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.network.brokers import BROKERS, Message, RunningBroker, wait_until
from tests.integration.revocation.connections import connect

STREAM_S = 0.01
"""Interval between setpoints [s]."""
CUT_S = 1.0
"""99th percentile of the time until both sessions are disconnected [s]."""
_log = logging.getLogger(__name__)


@dataclass
class ExecutedMessages:
    """Records the messages that an agent would execute: none with an epoch below the newest one.

    Attributes:
        executed_s: Sending time of each executed setpoint or command, according to the sender [s].
    """

    robot: Robot
    epoch: int = 0
    executed_s: list[float] = field(default_factory=list)
    command_ids: list[str] = field(default_factory=list)
    late: int = 0

    def watch(self) -> None:
        handle = self.robot.handle

        def record(message: Message) -> None:
            topic = topics.parse(message.topic)
            if topic.kind == topics.CTL:
                self._record(int(topic.name), float(message.payload))
                return
            before = len(self.robot.commands)
            handle(message)
            for command in self.robot.commands[before:]:
                if isinstance(command.request, GrantLease | ReleaseLease):
                    self.epoch = max(self.epoch, command.epoch)
                elif isinstance(command.request, MoveJoints):
                    self._record(command.epoch, 0.0)
                    self.command_ids.append(command.id)

        self.robot.handle = record  # type: ignore[method-assign]

    def _record(self, epoch: int, sent_s: float) -> None:
        if epoch < self.epoch:
            self.late += 1
        else:
            self.executed_s.append(sent_s)


def one_round(
    broker: RunningBroker, anna: Person, bert: Person, executed: ExecutedMessages, rng: random.Random
) -> float:
    """Share, operate, and end the share meanwhile. Returns the time until both sessions were disconnected [s]."""
    robot, at = executed.robot, f"/devices/{executed.robot.device}/shares"
    assert anna.post(at, {"account": bert.name, "role": "operator"}).status_code == 201
    epoch = bert.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
    page = connect(broker, bert, purpose="view")
    stick = connect(broker, bert, purpose="control", device=robot.device, epoch=epoch)
    topic = f"{topics.ROOT}/{robot.space}/{robot.id}/{robot.names[0]}/{topics.CTL}/{epoch}"
    ended = threading.Event()

    def stream() -> None:
        while not (stick.disconnected.is_set() or ended.is_set()):
            stick.publish(topic, repr(time.monotonic()), qos=0)
            time.sleep(STREAM_S)

    def start_actions() -> None:
        while not ended.is_set():
            answer = bert.start(robot.device, epoch=epoch)
            if answer.status_code == 404:
                return
            assert answer.status_code in {202, 409}, answer.text

    before = len(executed.executed_s)
    with ThreadPoolExecutor() as pool:
        running = [pool.submit(stream), pool.submit(start_actions)]
        try:
            wait_until(lambda: len(executed.executed_s) > before + 3, "setpoints at the robot")
            time.sleep(rng.uniform(0.0, 0.05))
            requested_s = time.monotonic()
            assert anna.delete(f"{at}/{bert.account}").status_code == 204
            response_s = time.monotonic()
            wait_until(
                lambda: page.disconnected.is_set() and stick.disconnected.is_set(), "the end of both connections"
            )
            disconnected_s = time.monotonic() - requested_s
        finally:
            ended.set()
        for each in running:
            each.result(20)
    for client in (page, stick):
        client.close()
    wait_until(lambda: executed.epoch > epoch, "the revoked epoch at the robot")
    problem(bert.start(robot.device, epoch=epoch), 404, "device-unknown")
    problem(bert.take_lease(robot.device, epoch=epoch), 404, "device-unknown")
    assert [sent_s for sent_s in executed.executed_s if sent_s > response_s] == [], (
        "a message sent after the end of the share was executed"
    )
    for action in executed.command_ids:
        assert anna.action(action)["status"] in {"unknown", "failed", "done"}
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    executed.command_ids.clear()
    return disconnected_s


@pytest.mark.parametrize("broker", BROKERS, indirect=True)
@pytest.mark.parametrize("number", [3, pytest.param(200, marks=[pytest.mark.long, pytest.mark.timeout(1_800)])])
def test_an_operator_is_disconnected_at_the_end_of_a_share_and_later_messages_are_not_executed(
    cloud: Cloud, broker: RunningBroker, pair: tuple[Person, Robot], number: int
) -> None:
    anna, robot = pair
    bert, executed, rng = cloud.sign_in("bert"), ExecutedMessages(robot), random.Random(number)  # noqa: S311 (a repeatable sequence)
    executed.watch()
    times_s = sorted(one_round(broker, anna, bert, executed, rng) for _ in range(number))
    p99_s = times_s[int(0.99 * len(times_s))]
    _log.warning(
        "%s: %d rounds, disconnected after %.0f ms (median), %.0f ms (p99), %.0f ms (maximum); none executed later",
        broker.kind, len(times_s), 1000 * statistics.median(times_s), 1000 * p99_s, 1000 * times_s[-1],
    )  # fmt: skip
    assert number < 100 or p99_s <= CUT_S

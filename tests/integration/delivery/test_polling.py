"""An agent that speaks nothing but HTTP does all that one on MQTT does."""

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.protocol import (
    AckStatus,
    CancelAction,
    GrantLease,
    MoveJoints,
    ReleaseLease,
    RunMovement,
    StopDevice,
    topics,
)
from function_app.domain.devices.devices import POLL_MARK_MS, POLL_SILENT_MS
from function_app.services.messaging.command_sender import SHORT_TTL_MS, STOP_KEPT_MS
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.polling import PollingRobot
from tests.harness.network.brokers import wait_until
from tests.integration.conftest import OpenCloud

BOTH = pytest.mark.parametrize("wait_ms", [0, 500], ids=["plain", "long"])
MINE = "/robot-types/ur5/movements/mine"
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


def mailbox(cloud: Cloud, robot: PollingRobot) -> list[str]:
    page = cloud.run(cloud.functions.tables.query(records.MAILBOX, robot.id, limit=1000))
    return [row.key for row in page.rows]


def letters(cloud: Cloud, robot: PollingRobot) -> list[str]:
    return [key for key in mailbox(cloud, robot) if not key.startswith("ack:")]


class TestAllThatMqttDoes:
    @BOTH
    def test_lease_action_end_stop_and_reset(
        self, cloud: Cloud, anna: Person, robot: PollingRobot, wait_ms: int
    ) -> None:
        robot.wait_ms = wait_ms
        robot.connect()
        assert anna.get(f"/devices/{robot.device}").json()["online"]
        anna.put(MINE, {"source": "robot.home()"})
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
        problem(anna.delete(f"/devices/{robot.device}/lease?epoch={lease['epoch']}"), 409, "lease-lost")
        again = anna.take(robot.device, wait_ms=10_000).json()["epoch"]
        assert anna.delete(f"/devices/{robot.device}/lease?epoch={again}").status_code == 204
        wait_until(lambda: robot.heard(ReleaseLease), "the release")
        assert robot.stops == [], "the signed command alone: it is kept until it is answered"
        wait_until(lambda: letters(cloud, robot) == [], "an empty mailbox")
        assert all(len(payloads) == 1 for payloads in robot.payloads.values()), "each once, when all goes well"

    def test_a_device_that_says_no_confirms_nothing(self, anna: Person, robot: PollingRobot) -> None:
        asking = anna.begin("POST", f"/devices/{robot.device}/lease", json={"wait_ms": 20_000})
        (item,) = robot.fetch(wait_ms=10_000)
        began = time.monotonic()
        robot.tell_ack(item["id"], AckStatus.RECEIVED)
        robot.tell_ack(item["id"], AckStatus.FAILED)
        assert asking().json()["confirmed"] is False
        assert time.monotonic() - began < 10, "an answer that says no is an answer"

    def test_without_a_broker_anywhere(self, open_cloud: OpenCloud) -> None:
        cloud = open_cloud()
        anna = cloud.sign_in("anna")
        with PollingRobot(cloud) as robot:
            robot.pair(anna)
            robot.connect()
            assert anna.take(robot.device, wait_ms=10_000).json()["confirmed"]
            action = anna.start(robot.device, wait_ms=10_000).json()
            assert action["status"] == "started"
            robot.report(action["id"], AckStatus.DONE)
            assert anna.action(action["id"], wait_ms=10_000)["status"] == "done"
            assert anna.post(f"/devices/{robot.device}/stop").json() == {"confirmed": True}

    def test_an_agent_that_comes_back_on_mqtt_is_reached_there(self, anna: Person, robot: PollingRobot) -> None:
        robot.connect()
        assert anna.take(robot.device, wait_ms=10_000).json()["confirmed"]
        robot.__exit__()
        assert robot.enroll(transport="mqtt").status_code == 200
        Robot.connect(robot)
        before = len(robot.heard(GrantLease))
        assert anna.take(robot.device, wait_ms=10_000).json()["confirmed"]
        assert len(robot.heard(GrantLease)) == before + 1
        assert robot.fetch() == []


class TestMailbox:
    def test_a_command_comes_again_with_the_same_bytes_until_it_is_answered(
        self, cloud: Cloud, anna: Person, robot: PollingRobot
    ) -> None:
        assert robot.fetch() == []
        action = anna.start(robot.device).json()["id"]
        (first,) = robot.fetch()
        assert first["id"] == action
        assert first["topic"] == robot.topic(topics.CMD)
        cloud.clock.advance(1.1)
        cloud.sweep()
        assert robot.fetch() == [first], "sent again by the timer it is still one"
        assert robot.fetch(have=[action]) == []
        assert robot.fetch(have=["another"]) == [first]
        assert robot.tell_ack(action, AckStatus.RECEIVED) == {"status": "stored", "detail": None}
        assert robot.fetch() == []
        assert anna.action(action)["status"] == "received"

    def test_stop_comes_first_then_the_oldest(self, cloud: Cloud, anna: Person, robot: PollingRobot) -> None:
        for _ in range(3):
            anna.take(robot.device, wait_ms=0)
            cloud.clock.advance(0.01)
        anna.post(f"/devices/{robot.device}/stop")
        found = robot.fetch()
        assert [item["id"] for item in robot.fetch(limit=2)] == [item["id"] for item in found[:2]]
        requests = robot.read(found)
        assert [type(request) for request in requests] == [StopDevice, GrantLease, GrantLease, GrantLease]
        assert [command.epoch for command in robot.heard(GrantLease)] == [1, 2, 3]

    def test_what_ran_out_is_not_given_and_a_late_stop_still_is(
        self, cloud: Cloud, anna: Person, robot: PollingRobot
    ) -> None:
        anna.take(robot.device, wait_ms=0)
        anna.post(f"/devices/{robot.device}/stop")
        cloud.clock.advance(SHORT_TTL_MS / 1000)
        assert [type(request) for request in robot.read(robot.fetch())] == [StopDevice]
        cloud.clock.advance((STOP_KEPT_MS - SHORT_TTL_MS) / 1000)
        assert robot.fetch() == []

    def test_an_action_that_was_cancelled_before_it_was_fetched_is_never_seen(
        self, cloud: Cloud, anna: Person, robot: PollingRobot
    ) -> None:
        robot.fetch()
        action = anna.start(robot.device).json()["id"]
        assert anna.post(f"/actions/{action}/cancel").status_code == 202
        assert robot.read(robot.fetch()) == [CancelAction(action=action)]
        cloud.clock.advance(1.1)
        cloud.sweep()
        assert not any(isinstance(request, MoveJoints) for request in robot.read(robot.fetch()))

    def test_entries_expire_when_the_agent_does_not_poll(self, cloud: Cloud, anna: Person, robot: PollingRobot) -> None:
        anna.take(robot.device, wait_ms=100)
        anna.post(f"/devices/{robot.device}/stop")
        assert len(mailbox(cloud, robot)) == 4, "two commands, and a place for the answer to each"
        cloud.clock.advance(3600)
        for _ in range(3):
            cloud.sweep()
        assert mailbox(cloud, robot) == []

    def test_a_command_of_any_length_and_letters_fits(self, anna: Person, robot: PollingRobot) -> None:
        robot.fetch()
        for source in ('"' * 45_000, "\\" * 45_000, "ü" * 45_000):
            made = anna.put(MINE, {"source": f"#{source}"})
            assert made.status_code in {200, 201}, made.text
            action = anna.start(robot.device, request={"kind": "run_movement", "name": "mine"})
            assert action.status_code == 202, action.text
            (request,) = robot.read(robot.fetch())
            assert source in request.source
            robot.tell_ack(action.json()["id"], AckStatus.DONE)

    def test_many_commands_come_in_pages_of_bounded_size(self, anna: Person, cloud: Cloud) -> None:
        names = [f"arm{number}" for number in range(12)]
        with PollingRobot(cloud, *names) as robot:
            robot.pair(anna)
            robot.fetch()
            assert anna.put(MINE, {"source": "#" + "ü" * 48_000}).status_code == 201
            request = {"kind": "run_movement", "name": "mine"}
            started = [anna.start(device, request=request).json()["id"] for device in robot.devices]
            first = [item["id"] for item in robot.fetch(limit=32)]
            second = [item["id"] for item in robot.fetch(limit=32, have=first)]
            assert len(first) == 10, "one answer holds about a megabyte"
            assert sorted(first + second) == sorted(started)

    @pytest.mark.parametrize("there", ["here", "elsewhere"])
    def test_a_long_poll_ends_when_a_command_comes(
        self, cloud: Cloud, open_cloud: OpenCloud, anna: Person, robot: PollingRobot, there: str
    ) -> None:
        found: list[Any] = []
        asking = threading.Thread(target=lambda: found.extend(robot.fetch(wait_ms=30_000)))
        began = time.monotonic()
        asking.start()
        time.sleep(0.2)
        assert found == []
        if there == "elsewhere":
            from tests.harness.crash_injection import elsewhere

            anna = elsewhere(open_cloud(clock=cloud.clock), anna)
        action = anna.start(robot.device).json()["id"]
        asking.join()
        assert [item["id"] for item in found] == [action]
        assert time.monotonic() - began < 20

    def test_a_long_poll_of_nothing_ends_in_time_with_nothing(self, robot: PollingRobot) -> None:
        began = time.monotonic()
        assert robot.fetch(wait_ms=300) == []
        assert time.monotonic() - began >= 0.3


class TestPresence:
    def test_asking_is_being_there_and_is_seldom_written_down(
        self, cloud: Cloud, anna: Person, robot: PollingRobot
    ) -> None:
        def link() -> Any:
            return cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "link"))

        assert not anna.get(f"/devices/{robot.device}").json()["online"]
        robot.fetch()
        assert anna.get(f"/devices/{robot.device}").json()["online"]
        first = link()
        for _ in range(5):
            robot.fetch()
            robot.tell_raw((robot.topic(topics.ACK), b"{}"))
        assert link() == first
        cloud.clock.advance(POLL_MARK_MS / 1000)
        robot.fetch()
        assert link() != first

    def test_who_stops_asking_is_offline_and_who_asks_again_is_not(
        self, cloud: Cloud, anna: Person, robot: PollingRobot
    ) -> None:
        robot.fetch()
        cloud.clock.advance(POLL_SILENT_MS / 1000 + 1)
        assert not anna.get(f"/devices/{robot.device}").json()["online"]
        problem(anna.start(robot.device), 409, "device-offline")
        robot.fetch()
        assert anna.get(f"/devices/{robot.device}").json()["online"]
        assert anna.start(robot.device).status_code == 202

    def test_a_goodbye_is_believed_at_once(self, anna: Person, robot: PollingRobot) -> None:
        robot.connect()
        robot.__exit__()
        robot.say_presence(online=False)
        assert not anna.get(f"/devices/{robot.device}").json()["online"]
        problem(anna.start(robot.device), 409, "device-offline")
        robot.fetch()
        assert anna.get(f"/devices/{robot.device}").json()["online"]


def test_where_the_bus_hears_no_acks_confirmation_is_read_from_the_tables(
    open_cloud: OpenCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As over IoT Core and Event Grid: the bus publishes, and acks come to the ingest, perhaps of another instance."""
    import contextlib
    from collections.abc import AsyncIterator

    from function_app.adapters import factory
    from function_app.adapters.local.command_bus import MqttCommandBus
    from tests.harness.cloud.cloud import paired

    class Deaf(MqttCommandBus):
        @contextlib.asynccontextmanager
        async def acks(self, device_topic: str, command: str) -> AsyncIterator[None]:  # noqa: ARG002
            yield None

    ingesting = open_cloud()
    ingesting.start_ingest()
    monkeypatch.setattr(factory, "MqttCommandBus", Deaf)
    cloud = open_cloud(clock=ingesting.clock)
    with paired(cloud) as (anna, robot):
        assert anna.take(robot.device, wait_ms=20_000).json()["confirmed"]
        assert anna.start(robot.device, wait_ms=20_000).json()["status"] == "started"
        robot.silent = True
        assert anna.take(robot.device, wait_ms=300).json()["confirmed"] is False

"""Lifecycle of a fault that one or several sources report."""

from typing import Any

import pytest

from device_agent.protocol import Fault, Mode, Presence, State, codec, topics
from function_app.domain.devices.devices import SILENT_MS, Device
from function_app.domain.health.faults import Report, Severity, Source
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.ingest.router import ingest
from function_app.services.health.faults import KEEP_FAULTS_MS, MAX_OPEN
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]


def hear(cloud: Cloud, topic: str, message: Any) -> None:
    """As if the broker had delivered it."""
    cloud.run(ingest(cloud.functions, topic, codec.encode(message)))


def state(cloud: Cloud, *codes: str) -> State:
    now_ms = cloud.clock.now_ms()
    found = tuple(Fault(code=code, message=f"{code}: look at it.", since_ms=now_ms) for code in codes)
    return State(device="arm", at_ms=now_ms, tick_ms=now_ms, mode=Mode.IDLE, epoch=0, faults=found)


def say(cloud: Cloud, robot: Robot, *codes: str) -> None:
    """A state with these faults, a moment after the one before."""
    cloud.clock.advance(0.01)
    hear(cloud, robot.topic(topics.STATE), state(cloud, *codes))


def faults(who: Person, robot: Robot, **query: Any) -> list[dict[str, Any]]:
    answer = who.get(f"/devices/{robot.device}/faults", params=query)
    assert answer.status_code == 200, answer.text
    items: list[dict[str, Any]] = answer.json()["items"]
    return items


def told(cloud: Cloud, robot: Robot) -> list[str]:
    """The kinds of the device's events, oldest first."""
    who = cloud.sign_in("anna")
    page = who.get(f"/devices/{robot.device}/events", params={"limit": 1000}).json()
    return [event["kind"] for event in sorted(page["items"], key=lambda event: event["at"])]


def device(cloud: Cloud, who: Person, robot: Robot) -> Device:
    return cloud.run(cloud.functions.devices.get(Identity(who.account, who.name, who.session), robot.device))


def heat(severity: Severity = Severity.WARNING) -> Report:
    return Report("heat", Source.DETECTOR, "level", severity, f"It is hot ({severity}). Let it cool.", value=75.0)


def test_what_a_device_reports_is_raised_acknowledged_cleared_and_remembered(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    say(cloud, robot, "encoder")
    (fault,) = faults(anna, robot, open=True)
    assert (fault["code"], fault["state"], fault["source"], fault["severity"]) == (
        "encoder",
        "raised",
        "device",
        "error",
    )
    assert fault["message"] == "encoder: look at it."
    cloud.clock.advance(1)
    answer = anna.post(f"/devices/{robot.device}/faults/{fault['id']}/acknowledge")
    assert answer.status_code == 200, answer.text
    assert (answer.json()["state"], answer.json()["acknowledged_by"]) == ("acknowledged", "anna")
    say(cloud, robot, "encoder")
    assert faults(anna, robot, open=True)[0]["state"] == "acknowledged", "there until it is cleared"
    cloud.clock.advance(1)
    say(cloud, robot)
    assert faults(anna, robot, open=True) == []
    (past,) = faults(anna, robot, open=False)
    assert (past["id"], past["state"]) == (fault["id"], "cleared")
    assert past["raised_at"] < past["acknowledged_at"] < past["cleared_at"]
    assert told(cloud, robot) == ["fault-raised", "fault-acknowledged", "fault-cleared"]
    problem(anna.post(f"/devices/{robot.device}/faults/{fault['id']}/acknowledge"), 409, "fault-cleared")
    say(cloud, robot, "encoder")
    (again,) = faults(anna, robot, open=True)
    assert (again["count"], again["state"]) == (2, "raised")
    assert [item["count"] for item in faults(anna, robot)] == [2, 1]


def test_it_comes_over_the_broker(pair: Pair) -> None:
    anna, robot = pair
    robot.say_state(state(robot.cloud, "brake"))
    wait_until(lambda: faults(anna, robot, open=True), "the fault")
    robot.say_state(state(robot.cloud))
    wait_until(lambda: not faults(anna, robot, open=True), "its end")


def test_what_got_worse_wants_to_be_acknowledged_again(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    arm = device(cloud, anna, robot)
    settle = cloud.functions.faults.settle
    cloud.run(settle(arm, "detector/health", [heat()]))
    (fault,) = faults(anna, robot)
    anna.post(f"/devices/{robot.device}/faults/{fault['id']}/acknowledge")
    cloud.run(settle(arm, "detector/health", [heat(Severity.ERROR)]))
    cloud.run(settle(arm, "detector/health", [heat()]))
    (worse,) = faults(anna, robot)
    assert (worse["id"], worse["severity"], worse["state"], worse["worsened"]) == (fault["id"], "error", "raised", 1)
    assert worse["message"] == "It is hot (error). Let it cool."
    assert told(cloud, robot)[-1] == "fault-worsened"


def test_one_scope_does_not_clear_what_another_reports(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    arm = device(cloud, anna, robot)
    cloud.run(cloud.functions.faults.settle(arm, "detector/health", [heat()]))
    say(cloud, robot, "heat")
    cloud.run(cloud.functions.faults.settle(arm, "detector/power", []))
    assert [fault["source"] for fault in faults(anna, robot, open=True)] == ["device", "detector"], "worst first"
    say(cloud, robot)
    assert [fault["source"] for fault in faults(anna, robot, open=True)] == ["detector"]


def test_however_many_notice_it_at_once_it_is_one_fault_with_one_event(open_cloud: Any, cloud: Cloud) -> None:
    clouds = [cloud, open_cloud(clock=cloud.clock)]
    with paired(cloud) as (anna, robot):
        arm = device(cloud, anna, robot)
        for turn in range(5):
            for reports in ([heat()], []):
                calls = [
                    one.begin(one.functions.faults.settle(arm, "detector/x", reports))
                    for one in clouds
                    for _ in range(4)
                ]
                for finish in calls:
                    finish()
                cloud.clock.advance(0.1)
                assert len(faults(anna, robot, open=True)) == len(reports)
            assert [fault["count"] for fault in faults(anna, robot, open=False)] == list(range(turn + 1, 0, -1))
        assert told(cloud, robot) == ["fault-raised", "fault-cleared"] * 5


def test_a_kill_between_any_two_writes_loses_no_fault_and_no_event(
    cloud: Cloud, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    anna, robot = pair
    tables = cloud.functions.tables
    arm = device(cloud, anna, robot)
    real = {name: getattr(tables, name) for name in ("create", "replace", "delete", "batch")}

    def killed_at(number: int) -> None:
        """The call dies instead of its write of this number."""
        left = number

        def dying(name: str) -> Any:
            async def write(*arguments: Any) -> Any:
                nonlocal left
                left -= 1
                if left < 0:
                    raise RuntimeError("killed")
                return await real[name](*arguments)

            return write

        for name in real:
            monkeypatch.setattr(tables, name, dying(name))

    steps = 0
    for reports in ([heat()], [heat(Severity.ERROR)], []):
        number = 0
        while True:
            killed_at(number)
            try:
                cloud.run(cloud.functions.faults.settle(arm, "detector/x", reports))
            except RuntimeError:
                number += 1
                monkeypatch.undo()
                continue
            monkeypatch.undo()
            break
        steps += number
        cloud.clock.advance(0.1)
    assert steps >= 6, "it was killed at least that often"
    (past,) = faults(anna, robot)
    assert (past["state"], past["count"], past["worsened"]) == ("cleared", 1, 1)
    assert told(cloud, robot) == ["fault-raised", "fault-worsened", "fault-cleared"]


class TestSilence:
    """A device of which nothing is heard any more."""

    def open(self, who: Person, robot: Robot) -> list[str]:
        return [fault["code"] for fault in faults(who, robot, open=True)]

    def test_it_is_a_fault_until_it_is_heard_again(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        say(cloud, robot)
        cloud.clock.advance(SILENT_MS / 1000 - 5)
        cloud.sweep()
        assert self.open(anna, robot) == []
        cloud.clock.advance(10)
        cloud.sweep()
        assert self.open(anna, robot) == ["silent"]
        say(cloud, robot)
        assert self.open(anna, robot) == []
        cloud.clock.advance(SILENT_MS / 1000 + 5)
        cloud.sweep()
        assert self.open(anna, robot) == ["silent"], "it is watched again"
        robot.session += 1
        hear(cloud, topics.conn(robot.space, robot.id), Presence(online=True, session=robot.session, at_ms=0))
        assert self.open(anna, robot) == []

    def test_one_that_is_heard_is_watched_on_with_one_note(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        for _ in range(12):
            cloud.clock.advance(30)
            say(cloud, robot)
            cloud.sweep()
        assert faults(anna, robot) == []
        notes = [
            row
            for shard in range(4)
            for row in cloud.run(cloud.functions.tables.query(records.WATCHED, str(shard))).rows
            if row.key.endswith(robot.id) and not row.key.startswith("agent:")
        ]
        assert len(notes) == 1

    def test_one_that_said_good_bye_is_well(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        hear(cloud, topics.conn(robot.space, robot.id), Presence(online=False, session=robot.session, at_ms=0))
        cloud.clock.advance(SILENT_MS / 1000 + 5)
        cloud.sweep()
        assert faults(anna, robot) == []

    def test_a_message_that_is_delivered_again_is_no_sign_of_life(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        last = state(cloud)
        hear(cloud, robot.topic(topics.STATE), last)
        cloud.clock.advance(SILENT_MS / 1000 + 5)
        cloud.sweep()
        hear(cloud, robot.topic(topics.STATE), last)
        assert self.open(anna, robot) == ["silent"]


def test_faults_of_another_account_can_be_neither_read_nor_acknowledged(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    say(cloud, robot, "encoder")
    (fault,) = faults(anna, robot)
    acknowledge = f"/devices/{robot.device}/faults/{fault['id']}/acknowledge"
    bert = cloud.sign_in("bert")
    problem(bert.get(f"/devices/{robot.device}/faults"), 404, "device-unknown")
    problem(bert.post(acknowledge), 404, "device-unknown")
    for unknown in ("x", "%00", "a" * 500, fault["id"][:-1]):
        problem(anna.post(f"/devices/{robot.device}/faults/{unknown}/acknowledge"), 404, "fault-unknown")
    problem(anna.get(f"/devices/{robot.device}/faults", params={"cursor": "x"}), 422, "cursor-invalid")
    anna.delete(f"/agents/{robot.id}")
    robot.pair(bert)
    assert faults(bert, robot) == [], "an earlier owner's faults are not his"


def test_the_history_pages_and_is_forgotten_in_time(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    for number in range(5):
        say(cloud, robot, f"code-{number}")
    say(cloud, robot)
    first = anna.get(f"/devices/{robot.device}/faults", params={"limit": 3}).json()
    second = anna.get(f"/devices/{robot.device}/faults", params={"limit": 3, "cursor": first["cursor"]}).json()
    assert [item["code"] for item in first["items"] + second["items"]] == [f"code-{n}" for n in (4, 3, 2, 1, 0)]
    cloud.clock.advance(KEEP_FAULTS_MS / 1000 + 10)
    cloud.sweep()
    arm = device(cloud, anna, robot)
    rows = cloud.run(cloud.functions.tables.query(records.FAULTS, f"{arm.id}/{arm.pairing}")).rows
    assert [row.key for row in rows if ":cloud:" not in row.key] == []


def test_a_device_that_reports_without_measure_is_bounded(cloud: Cloud, pair: Pair) -> None:
    anna, robot = pair
    say(cloud, robot, *(f"code-{number}" for number in range(MAX_OPEN + 50)))
    assert len(faults(anna, robot, open=True)) == MAX_OPEN
    say(cloud, robot, "x" * 200, "", "ü:\n/\\#?", "open:cloud:silent")
    assert {fault["code"] for fault in faults(anna, robot, open=True)} == {
        "x" * 200,
        "",
        "ü:\n/\\#?",
        "open:cloud:silent",
    }

"""Lifecycle of faults from one or several sources."""

import contextlib
import itertools
from typing import Any

import msgspec

from device_agent.protocol import Fault, Mode, State
from function_app.domain.devices.devices import SILENT_MS, Device
from function_app.domain.health.faults import Report, Severity, Source
from function_app.domain.identity.accounts import Identity
from function_app.services.health.faults import KEEP_FAULTS_MS, MAX_OPEN
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fixtures.cloud import Crashing
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.crash_injection import Killed


def state(cloud: Cloud, *codes: str) -> State:
    now_ms = cloud.clock.now_ms()
    reported = tuple(Fault(code=code, message=f"{code}: inspect it.", since_ms=now_ms) for code in codes)
    return State(device="arm", at_ms=now_ms, tick_ms=now_ms, mode=Mode.IDLE, epoch=0, faults=reported)


def report_faults(cloud: Cloud, robot: Robot, *codes: str) -> None:
    """Ingest a later state with these faults."""
    cloud.clock.advance(0.01)
    robot.publish_state(state(cloud, *codes))


def faults(person: Person, robot: Robot, **query: Any) -> list[dict[str, Any]]:
    return person.pages(f"/devices/{robot.device}/faults", **query)


def events(person: Person, robot: Robot) -> list[str]:
    """The kinds of the device's events, oldest first."""
    items = person.pages(f"/devices/{robot.device}/events")
    return [event["kind"] for event in sorted(items, key=lambda event: str(event["at"]))]


def device(cloud: Cloud, person: Person, robot: Robot) -> Device:
    return cloud.run(cloud.functions.devices.get(Identity(person.account, person.name, person.session), robot.device))


def heat(severity: Severity = Severity.WARNING) -> Report:
    return Report("heat", Source.DETECTOR, "level", severity, f"It is hot ({severity}). Let it cool.", value=75.0)


def test_a_reported_fault_is_raised_acknowledged_and_cleared(cloud: Cloud, anna: Person, robot: Robot) -> None:
    report_faults(cloud, robot, "encoder")
    (fault,) = faults(anna, robot, open=True)
    expected = {"code": "encoder", "state": "raised", "source": "device", "severity": "error"}
    assert fault.items() >= (expected | {"message": "encoder: inspect it."}).items()
    cloud.clock.advance(1)
    answer = anna.post(f"/devices/{robot.device}/faults/{fault['id']}/acknowledge")
    assert answer.status_code == 200, answer.text
    assert (answer.json()["state"], answer.json()["acknowledged_by"]) == ("acknowledged", "anna")
    report_faults(cloud, robot, "encoder")
    assert faults(anna, robot, open=True)[0]["state"] == "acknowledged", "it stays open until it is cleared"
    cloud.clock.advance(1)
    report_faults(cloud, robot)
    assert faults(anna, robot, open=True) == []
    (past,) = faults(anna, robot, open=False)
    assert (past["id"], past["state"]) == (fault["id"], "cleared")
    assert past["raised_at"] < past["acknowledged_at"] < past["cleared_at"]
    assert events(anna, robot) == ["fault-raised", "fault-acknowledged", "fault-cleared"]
    problem(anna.post(f"/devices/{robot.device}/faults/{fault['id']}/acknowledge"), 409, "fault-cleared")
    report_faults(cloud, robot, "encoder")
    (again,) = faults(anna, robot, open=True)
    assert (again["count"], again["state"]) == (2, "raised")
    assert [item["count"] for item in faults(anna, robot)] == [2, 1]


def test_further_occurrences_are_counted_in_the_open_fault_without_events(
    cloud: Cloud, anna: Person, robot: Robot
) -> None:
    for count in range(1, 6):
        cloud.clock.advance(30)
        flapping = Fault(code="silent.camera", message="No image. Check it.", since_ms=1, count=count)
        robot.publish_state(msgspec.structs.replace(state(cloud), faults=(flapping,)))
    (fault,) = faults(anna, robot)
    assert (fault["count"], fault["occurrences"], fault["state"]) == (1, 5, "raised")
    assert fault["last_seen_at"] > fault["raised_at"]
    assert events(anna, robot) == ["fault-raised"]


def test_a_worsened_fault_must_be_acknowledged_again(cloud: Cloud, anna: Person, robot: Robot) -> None:
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
    assert events(anna, robot)[-1] == "fault-worsened"


def test_each_source_clears_its_own_faults_only(cloud: Cloud, anna: Person, robot: Robot) -> None:
    arm = device(cloud, anna, robot)
    cloud.run(cloud.functions.faults.settle(arm, "detector/health", [heat()]))
    report_faults(cloud, robot, "heat")
    cloud.run(cloud.functions.faults.settle(arm, "detector/power", []))
    assert [fault["source"] for fault in faults(anna, robot, open=True)] == ["device", "detector"], "worst first"
    report_faults(cloud, robot)
    assert [fault["source"] for fault in faults(anna, robot, open=True)] == ["detector"]


def test_concurrent_reports_are_one_fault_with_one_event(open_cloud: Any, cloud: Cloud) -> None:
    clouds = [cloud, open_cloud(clock=cloud.clock)]
    with paired(cloud) as (anna, robot):
        arm = device(cloud, anna, robot)
        for turn in range(5):
            for reports in ([heat()], []):
                instances = [one for one in clouds for _ in range(4)]
                for call in [one.begin(one.functions.faults.settle(arm, "detector/x", reports)) for one in instances]:
                    call()
                cloud.clock.advance(0.1)
                assert len(faults(anna, robot, open=True)) == len(reports)
            assert [fault["count"] for fault in faults(anna, robot, open=False)] == list(range(turn + 1, 0, -1))
        assert events(anna, robot) == ["fault-raised", "fault-cleared"] * 5


def test_a_kill_after_any_write_loses_nothing(cloud: Cloud, anna: Person, robot: Robot, crashing: Crashing) -> None:
    arm = device(cloud, anna, robot)
    kills = 0
    for reports in ([heat()], [heat(Severity.ERROR)], []):
        for writes in itertools.count(1):
            instance, crash = crashing(cloud.clock)
            crash.left = writes
            with contextlib.suppress(Killed):
                instance.run(instance.functions.faults.settle(arm, "detector/x", reports))
            if crash.survived:
                break
            kills += 1
        cloud.clock.advance(0.1)
    assert kills >= 3
    (past,) = faults(anna, robot)
    assert (past["state"], past["count"], past["worsened"]) == ("cleared", 1, 1)
    assert events(anna, robot) == ["fault-raised", "fault-worsened", "fault-cleared"]


class TestSilence:
    """A device that publishes nothing."""

    def open(self, person: Person, robot: Robot) -> list[str]:
        return [fault["code"] for fault in faults(person, robot, open=True)]

    def test_silence_is_a_fault_until_the_next_message(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        report_faults(cloud, robot)
        cloud.clock.advance(SILENT_MS / 1000 - 5)
        cloud.sweep()
        assert self.open(anna, robot) == []
        cloud.clock.advance(10)
        cloud.sweep()
        assert self.open(anna, robot) == ["silent"]
        report_faults(cloud, robot)
        assert self.open(anna, robot) == []
        cloud.clock.advance(SILENT_MS / 1000 + 5)
        cloud.sweep()
        assert self.open(anna, robot) == ["silent"], "it is monitored again"
        robot.publish_presence(online=True, session=robot.session + 1)
        assert self.open(anna, robot) == []

    def test_an_active_device_has_one_reminder(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        for _ in range(12):
            cloud.clock.advance(30)
            report_faults(cloud, robot)
            cloud.sweep()
        assert faults(anna, robot) == []
        notes = [
            row
            for shard in range(4)
            for row in cloud.run(cloud.functions.tables.query(records.WATCHED, str(shard))).rows
            if row.key.endswith(robot.id) and not row.key.startswith("agent:")
        ]
        assert len(notes) == 1

    def test_an_announced_disconnect_is_no_fault(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        robot.publish_presence(online=False)
        cloud.clock.advance(SILENT_MS / 1000 + 5)
        cloud.sweep()
        assert faults(anna, robot) == []

    def test_a_duplicate_message_does_not_end_the_silence(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        last = state(cloud)
        robot.publish_state(last)
        cloud.clock.advance(SILENT_MS / 1000 + 5)
        cloud.sweep()
        robot.publish_state(last)
        assert self.open(anna, robot) == ["silent"]


def test_faults_are_private_to_their_owner(cloud: Cloud, anna: Person, robot: Robot) -> None:
    report_faults(cloud, robot, "encoder")
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
    assert faults(bert, robot) == [], "a new owner does not see earlier faults"


def test_the_history_pages_and_expires(cloud: Cloud, anna: Person, robot: Robot) -> None:
    for number in range(5):
        report_faults(cloud, robot, f"code-{number}")
    report_faults(cloud, robot)
    assert [item["code"] for item in faults(anna, robot, limit=3)] == [f"code-{n}" for n in (4, 3, 2, 1, 0)]
    cloud.clock.advance(KEEP_FAULTS_MS / 1000 + 10)
    cloud.sweep()
    arm = device(cloud, anna, robot)
    rows = cloud.run(cloud.functions.tables.query(records.FAULTS, f"{arm.id}/{arm.pairing}")).rows
    assert [row.key for row in rows if ":cloud:" not in row.key] == []


def test_the_number_of_open_faults_is_bounded(cloud: Cloud, anna: Person, robot: Robot) -> None:
    report_faults(cloud, robot, *(f"code-{number}" for number in range(MAX_OPEN + 50)))
    assert len(faults(anna, robot, open=True)) == MAX_OPEN
    codes = {"x" * 200, "", "ü:/\\#?", "open:cloud:silent"}
    report_faults(cloud, robot, *codes)
    assert {fault["code"] for fault in faults(anna, robot, open=True)} == codes

"""Sessions and autonomy of a device: who controlled it, and who moved it."""

import json
from typing import Any
from unittest import mock

import pytest

from device_agent.protocol import AckStatus, Event, Reason, topics
from device_agent.protocol.errors import ProtocolError
from function_app.domain.actions.action import LOST, Status, end
from function_app.services.autonomy import autonomy_reader
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.actions.queue_requests import pass_time
from tests.unit.function_app.services.sharing.shares import share, unshare

DAY_S = 86_400


class Reporter:
    """Reports the activity of the arm, as its agent does."""

    def __init__(self, cloud: Cloud, robot: Robot) -> None:
        self._cloud = cloud
        self._robot = robot
        self._number = 0

    def __call__(self, epoch: int, operator_s: float, machine_s: float, **data: Any) -> None:
        self._number += 1
        event = Event(
            id=f"activity{self._number}",
            device="arm",
            at_ms=self._cloud.clock.now_ms(),
            kind="activity",
            severity="info",
            message="moved",
            data={"epoch": epoch, "operator_s": operator_s, "machine_s": machine_s, "first_input_s": None, **data},
        )
        self._robot.publish(self._robot.topic(topics.EVENT), event)


@pytest.fixture
def report(cloud: Cloud, robot: Robot) -> Reporter:
    return Reporter(cloud, robot)


def sessions(person: Person, robot: Robot) -> list[dict[str, Any]]:
    return person.pages(f"/devices/{robot.device}/sessions", limit=2)


def shares(person: Person, robot: Robot, **query: Any) -> dict[str, Any]:
    answer = person.get(f"/devices/{robot.device}/autonomy", params=query)
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def test_a_session_lasts_from_the_grant_to_the_end_of_the_lease(
    cloud: Cloud, anna: Person, robot: Robot, report: Reporter
) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    (open_,) = sessions(anna, robot)
    assert (open_["epoch"], open_["holder"], open_["action"], open_["ended_at"]) == (epoch, "anna", None, None)
    assert open_["share"] == {"operator_s": 0, "machine_s": 0, "hti": None, "mti": None, "mtia": None}
    report(epoch, 3.0, 1.0, first_input_s=0.8)
    cloud.clock.advance(8)
    anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}")
    (ended,) = sessions(anna, robot)
    assert (ended["start"], ended["end"], ended["first_input_s"]) == ("control-taken", "control-released", 0.8)
    assert ended["share"] == {"operator_s": 3, "machine_s": 1, "hti": 0.75, "mti": 0.25, "mtia": pytest.approx(1 / 3)}
    assert ended["ended_at"] > ended["started_at"]
    report_ = shares(anna, robot)
    assert (report_["takeover_s"], report_["workload"]) == (0.8, pytest.approx(3 / 8, abs=0.01))


def test_a_session_ends_with_the_next_one(cloud: Cloud, anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    bert.take_lease(robot.device)
    cloud.clock.advance(5)
    taken = anna.take_lease(robot.device, take_over=True, reason="smoke")
    assert taken.status_code in {200, 201}, taken.text
    newer, older = sessions(anna, robot)
    assert (newer["holder"], newer["start"], newer["ended_at"]) == ("anna", "control-taken-over", None)
    assert (older["holder"], older["ended_at"]) == ("bert", newer["started_at"])


def test_a_session_that_a_newer_page_ended_has_an_end(cloud: Cloud, anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    bert.take_lease(robot.device)
    cloud.clock.advance(5)
    anna.take_lease(robot.device, take_over=True, reason="smoke")
    newer, older = anna.pages(f"/devices/{robot.device}/sessions", limit=1)
    assert (older["holder"], older["ended_at"]) == ("bert", newer["started_at"])


@pytest.mark.parametrize(
    ("end", "outcome", "intervened"),
    [
        ("done", "done", False),
        ("cancel", "cancelled", True),
        ("stopped", "failed", True),
        ("broken", "failed", False),
        ("deadline", "cancelled", False),
    ],
)
def test_an_action_is_a_session_of_the_machine(
    cloud: Cloud, anna: Person, robot: Robot, report: Reporter, *, end: str, outcome: str, intervened: bool
) -> None:
    request = {"kind": "run_movement", "name": "wave"}
    action = anna.start(robot.device, request=request, wait_ms=10_000, timeout_ms=3_000).json()
    report(action["epoch"], 0.0, 2.5)
    if end == "cancel":
        anna.post(f"/actions/{action['id']}/cancel")
    if end == "deadline":
        pass_time(cloud, 4)
    reasons = {"stopped": Reason(code="stopped", message="x"), "broken": Reason(code="script", message="x")}
    status = {"done": AckStatus.DONE, "stopped": AckStatus.FAILED, "broken": AckStatus.FAILED}.get(
        end, AckStatus.CANCELLED
    )
    robot.report(action["id"], status, reason=reasons.get(end))
    pass_time(cloud, 20)
    (session,) = sessions(anna, robot)
    assert (session["action"], session["task"], session["outcome"]) == (action["id"], "wave", outcome)
    assert (session["intervened"], session["share"]["mti"], session["share"]["mtia"]) == (intervened, 1.0, None)
    assert session["ended_at"] is not None
    whole = shares(anna, robot)
    assert (whole["actions"], whole["interventions"], whole["workload"]) == (1, int(intervened), None)
    assert whole["tasks"] == [{"name": "wave", "share": session["share"]}]


def test_autonomy_over_time(cloud: Cloud, anna: Person, robot: Robot, report: Reporter) -> None:
    first_ms = cloud.clock.now_ms()
    for operator_s, machine_s in ((4.0, 0.0), (1.0, 3.0), (0.0, 2.0)):
        epoch = anna.take_lease(robot.device).json()["epoch"]
        report(epoch, operator_s, machine_s)
        anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}")
        cloud.clock.advance(DAY_S)
        anna = cloud.sign_in("anna")
    whole = shares(anna, robot)
    assert [each["share"]["hti"] for each in whole["days"]] == [1.0, 0.25, 0.0]
    assert (whole["share"]["operator_s"], whole["share"]["mtia"], whole["sessions"]) == (5.0, 1.0, 3)
    later = shares(anna, robot, **{"from": first_ms + DAY_S * 1000})
    assert (later["share"]["operator_s"], later["sessions"]) == (1.0, 2)
    earlier = shares(anna, robot, to=first_ms + DAY_S * 1000)
    assert (earlier["share"]["operator_s"], earlier["sessions"]) == (4.0, 1)


def test_reports_of_a_lost_link_count_once_and_late(anna: Person, robot: Robot, report: Reporter, cloud: Cloud) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    report(epoch, 5.0, 1.0)
    report(epoch, 2.0, 0.5)  # older, sent again after the link was lost
    report(epoch, 5.0, 1.0)
    assert shares(anna, robot)["share"]["operator_s"] == 5.0
    events = anna.get(f"/devices/{robot.device}/events").json()["items"]
    assert "activity" not in {each["kind"] for each in events}
    del cloud


@pytest.mark.parametrize(
    "data",
    [
        {"epoch": None},
        {"epoch": -1},
        {"epoch": 2**53 + 1},
        {"operator_s": "1"},
        {"machine_s": -1},
        {"machine_s": 1.1e9},
        {"first_input_s": "x"},
    ],
    ids=str,
)
def test_an_invalid_report_is_rejected(cloud: Cloud, anna: Person, robot: Robot, data: dict[str, Any]) -> None:
    fields = {"epoch": 1, "operator_s": 1.0, "machine_s": 1.0, "first_input_s": None, **data}
    event = {
        "id": "x",
        "device": "arm",
        "at_ms": 1,
        "kind": "activity",
        "severity": "info",
        "message": "",
        "data": fields,
    }
    topic = topics.parse(robot.topic(topics.EVENT))
    with pytest.raises(ProtocolError):
        cloud.run(cloud.functions.presence.ingest(topic, json.dumps(event).encode(), by="mqtt"))
    assert sessions(anna, robot) == []


def test_too_many_sessions_are_cut_and_reported(anna: Person, robot: Robot) -> None:
    for _ in range(3):
        epoch = anna.take_lease(robot.device).json()["epoch"]
        anna.delete(f"/devices/{robot.device}/lease?epoch={epoch}")
    assert shares(anna, robot)["complete"] is True
    with mock.patch.object(autonomy_reader, "MAX_SESSIONS", 2):
        assert (shares(anna, robot)["complete"], shares(anna, robot)["sessions"]) == (False, 2)


def test_strangers_and_former_owners_see_no_session(cloud: Cloud, anna: Person, bert: Person, robot: Robot) -> None:
    anna.take_lease(robot.device)
    for path in ("sessions", "autonomy"):
        problem(bert.get(f"/devices/{robot.device}/{path}"), 404, "device-unknown")
    share(anna, f"devices/{robot.device}", bert, "viewer")
    assert len(sessions(bert, robot)) == 1
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    robot.pair(anna)
    robot.connect()
    assert sessions(anna, robot) == []
    del cloud


def test_a_session_keeps_the_result_of_its_action_after_the_action_was_deleted(
    cloud: Cloud, anna: Person, robot: Robot, report: Reporter
) -> None:
    action = anna.start(robot.device, wait_ms=10_000).json()
    report(action["epoch"], 0.0, 1.0)
    robot.report(action["id"], AckStatus.DONE)
    pass_time(cloud, 20)
    with mock.patch.object(cloud.functions.action_store, "get", side_effect=AssertionError("not read again")):
        (session,) = sessions(anna, robot)
        assert shares(anna, robot)["actions"] == 1
    assert (session["task"], session["outcome"], session["action"]) == ("move_joints", "done", action["id"])


def test_a_late_report_replaces_the_outcome_of_a_lost_action(cloud: Cloud, anna: Person, robot: Robot) -> None:
    action = anna.start(robot.device, wait_ms=10_000).json()["id"]
    now_ms = cloud.clock.now_ms()
    cloud.run(cloud.functions.action_store.change(action, lambda stored: end(stored, Status.FAILED, LOST, "x", now_ms)))
    pass_time(cloud, 70)
    assert sessions(anna, robot)[0]["outcome"] == "failed"
    robot.report(action, AckStatus.DONE)
    assert sessions(anna, robot)[0]["outcome"] == "done"


def test_the_action_of_a_person_in_control_does_not_replace_their_session(
    cloud: Cloud, anna: Person, robot: Robot
) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    action = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
    robot.report(action, AckStatus.DONE)
    pass_time(cloud, 10)
    (session,) = sessions(anna, robot)
    assert (session["holder"], session["task"], session["outcome"], session["ended_at"]) == ("anna", None, None, None)


def test_a_report_before_the_start_of_its_session_counts_on_no_day(
    anna: Person, robot: Robot, report: Reporter
) -> None:
    report(1, 1.0, 1.0)
    assert (shares(anna, robot)["days"], shares(anna, robot)["sessions"]) == ([], 0)
    epoch = anna.take_lease(robot.device).json()["epoch"]
    assert epoch == 1
    assert shares(anna, robot)["share"]["operator_s"] == 1.0


@pytest.mark.parametrize(("how", "end"), [("unshare", "control-ended"), ("reset", "stop-reset-ordered")])
def test_a_session_ends_with_its_permission_and_with_the_reset_of_stop(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot, *, how: str, end: str
) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    epoch = bert.take_lease(robot.device).json()["epoch"]
    cloud.clock.advance(5)
    if how == "unshare":
        unshare(anna, f"devices/{robot.device}", bert)
    else:
        anna.post(f"/devices/{robot.device}/stop")
        anna.post(f"/devices/{robot.device}/stop/reset")
    pass_time(cloud, 20)
    (session,) = sessions(anna, robot)
    assert (session["epoch"], session["holder"], session["end"]) == (epoch, "bert", end)
    assert session["ended_at"] > session["started_at"]


def test_a_reset_without_control_starts_and_ends_no_session(anna: Person, robot: Robot) -> None:
    anna.post(f"/devices/{robot.device}/stop")
    anna.post(f"/devices/{robot.device}/stop/reset")
    assert sessions(anna, robot) == []


def test_an_action_with_an_unknown_outcome_does_not_last(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.silent = True
    anna.start(robot.device, ttl_ms=2_000)
    pass_time(cloud, 20)
    (session,) = sessions(anna, robot)
    assert session["outcome"] == "unknown"
    assert session["ended_at"] is not None


def test_an_epoch_that_only_an_agent_claims_hides_no_session(
    cloud: Cloud, anna: Person, robot: Robot, report: Reporter
) -> None:
    report(2**50, 1.0, 1.0)
    cloud.clock.advance(2 * DAY_S)
    anna = cloud.sign_in("anna")
    epoch = anna.take_lease(robot.device).json()["epoch"]
    report(epoch, 3.0, 0.0)
    since = {"from": cloud.clock.now_ms() - DAY_S * 1000}
    assert shares(anna, robot, **since)["share"]["operator_s"] == 3.0


def test_an_action_that_was_issued_again_counts_once(cloud: Cloud, anna: Person, robot: Robot) -> None:
    action = anna.start(robot.device, wait_ms=10_000).json()
    pass_time(cloud, 5)
    again = {"kind": "control-taken", "at_ms": cloud.clock.now_ms(), "data": {}}
    again["data"] = {"epoch": action["epoch"] + 4, "holder": "anna", "action": action["id"]}
    log, stored = cloud.functions.sessions_of_devices, cloud.run(cloud.functions.action_store.get(action["id"]))
    assert stored is not None
    cloud.run(log.add_control_event(robot.device, stored.action.pairing, again))
    assert len(sessions(anna, robot)) == 2
    assert shares(anna, robot)["actions"] == 1


def test_repeated_reports_write_and_schedule_nothing(
    cloud: Cloud, anna: Person, robot: Robot, report: Reporter
) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    report(epoch, 1.0, 0.0)
    tables, writes = cloud.functions.tables, []

    async def batch(table: str, changes: Any) -> Any:
        writes.append(table)
        return await type(tables).batch(tables, table, changes)

    with mock.patch.object(tables, "batch", batch):
        report(epoch, 1.0, 0.0)
    assert records.SESSIONS not in writes

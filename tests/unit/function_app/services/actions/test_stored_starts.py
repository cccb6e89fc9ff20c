"""What a start stores, and what it leaves when it is refused after a write."""

from typing import Any
from unittest import mock

import msgspec
import pytest

from device_agent.protocol import SHIPPED, MoveJoints, RunMovement
from function_app.domain.actions.action import RETRY_MS
from function_app.domain.common.json_depth import MAX_LEVELS
from function_app.domain.common.problems import not_found
from function_app.services.actions.start import ABANDON_MS, PINNED
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.unit.function_app.services.accounts.test_api_keys import make
from tests.unit.function_app.services.actions.queue_requests import control_rows, queued, reminders
from tests.unit.function_app.services.sharing.shares import share

MINE = "/robot-types/ur5/movements/mine"
COLLECT = {"kind": "gather", "streams": ["climate"], "rate_hz": 1, "duration_s": 2}


def stored(cloud: Cloud, action: str) -> dict[str, Any]:
    device, _, suffix = action.rpartition("-")
    return control_rows(cloud, device)[f"action:{suffix}"]


def once_rows(cloud: Cloud, device: str) -> dict[str, Any]:
    return {key: data for key, data in control_rows(cloud, device).items() if key.startswith("once:")}


def test_a_new_action_stores_its_request_and_limits(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.silent = True
    action = anna.start(robot.device, ttl_ms=5_000, timeout_ms=60_000, idempotency_key="k").json()["id"]
    (command,) = robot.received(MoveJoints)
    row = stored(cloud, action)
    created_ms = row["created_ms"]
    assert 0 <= cloud.clock.now_ms() - created_ms < 1_000
    (key,) = once_rows(cloud, robot.device)
    assert row | {"status": "published", "times": {}} == {
        "id": action,
        "device": robot.device,
        "account": anna.account,
        "caller": "anna",
        "pairing": row["pairing"],
        "request": msgspec.to_builtins(command.request),
        "epoch": 1,
        "created_ms": created_ms,
        "ttl_ms": 5_000,
        "deadline_ms": created_ms + 60_000,
        "status": "published",
        "pinned": {},
        "times": {},
        "reason": None,
        "progress": None,
        "output": "",
        "result": {},
        "sequence": -1,
        "cancel_id": "",
        "idempotency_key": key,
        "received": {},
        "session": anna.session,
        "timeout_ms": 60_000,
        "queued_until_ms": 0,
        "turn_ms": 0,
        "reissuable": True,
        "traceparent": "",
    }
    assert created_ms <= row["times"]["published"] <= cloud.clock.now_ms()
    assert once_rows(cloud, robot.device)[key]["action"] == action
    assert (command.issued_at_ms, command.ttl_ms, command.epoch, command.caller) == (created_ms, 5_000, 1, "anna")
    assert reminders(cloud) == [f"{created_ms + RETRY_MS:013d}:{action}"]


def test_a_queued_action_stores_the_end_of_its_queueing_time(
    cloud: Cloud, anna: Person, robot: Robot, running: str
) -> None:
    action = queued(anna, robot.device, queue_ms=20_000, timeout_ms=60_000, ttl_ms=5_000)
    row = stored(cloud, action)
    created_ms = row["created_ms"]
    assert (row["status"], row["epoch"], row["turn_ms"]) == ("queued", 0, 0)
    assert row["queued_until_ms"] == created_ms + 20_000
    assert row["deadline_ms"] == created_ms + 20_000 + 60_000
    assert control_rows(cloud, robot.device)["now:slot"]["action"] == running
    assert {key.partition(":")[2] for key in reminders(cloud)} >= {action, f"queue:{robot.device}"}


def test_the_time_to_live_is_at_most_the_time_limit(anna: Person, robot: Robot) -> None:
    anna.start(robot.device, ttl_ms=60_000, timeout_ms=2_000)
    (command,) = robot.received(MoveJoints)
    assert command.ttl_ms == 2_000


def test_a_movement_is_pinned_with_the_default_parameters(cloud: Cloud, anna: Person, robot: Robot) -> None:
    schema = {"type": "object", "properties": {"times": {"type": "integer", "default": 3}}}
    assert anna.put(MINE, {"source": "robot.home()", "parameters_schema": schema}).status_code == 201
    request = {"kind": "run_movement", "name": "mine"}
    action = anna.start(robot.device, request=request, timeout_ms=9_000).json()["id"]
    (command,) = robot.received(RunMovement)
    run = command.request
    assert isinstance(run, RunMovement)
    shown = anna.get(MINE).json()
    assert (run.name, run.robot_type, run.version, run.timeout_ms) == ("mine", "ur5", shown["version"], 9_000)
    assert (run.source, run.author, run.parameters) == ("robot.home()", anna.account, {"times": 3})
    assert run.key
    assert run.signature
    row = stored(cloud, action)
    assert row["pinned"] == {name: getattr(run, name) for name in PINNED}
    assert row["request"]["parameters"] == {"times": 3}


def test_a_built_in_movement_has_no_account_as_author(anna: Person, robot: Robot) -> None:
    anna.start(robot.device, request={"kind": "run_movement", "name": "slow_square"})
    (command,) = robot.received(RunMovement)
    assert isinstance(command.request, RunMovement)
    assert command.request.author == SHIPPED


def test_parameters_that_no_script_accepts_are_rejected_first(anna: Person, robot: Robot) -> None:
    nested: dict[str, Any] = {}
    for _ in range(MAX_LEVELS + 1):
        nested = {"a": nested}
    request = {"kind": "run_movement", "name": "missing", "parameters": nested}
    problem(anna.start(robot.device, request=request, idempotency_key="k"), 422, "parameters-invalid")
    problem(anna.start("aaaaaaaaaa-arm", request=request), 422, "parameters-invalid")


def test_the_first_action_after_an_expired_lease_records_its_end_for_the_owner(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot
) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    epoch = anna.take_lease(robot.device, lease_ms=1_000).json()["epoch"]
    cloud.clock.advance(2)
    action = bert.start(robot.device, wait_ms=10_000).json()["id"]
    rows = control_rows(cloud, robot.device)
    assert stored(cloud, action)["epoch"] == epoch + 1
    expired, taken = (rows[f"event:{name}"] for name in (f"control-expired-{epoch}", f"control-taken-{epoch + 1}"))
    assert (expired["owner"], taken["owner"], taken["by"]["account"]) == (anna.account, anna.account, bert.account)


def test_collecting_data_fits_into_the_time_limit(anna: Person, robot: Robot) -> None:
    problem(anna.start(robot.device, request=COLLECT, timeout_ms=1_999), 422, "invalid")
    assert anna.start(robot.device, request=COLLECT, timeout_ms=2_000, wait_ms=10_000).status_code == 200


def test_an_idempotency_key_ends_with_the_pairing(anna: Person, robot: Robot) -> None:
    first = anna.start(robot.device, idempotency_key="k").json()["id"]
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    robot.pair(anna)
    robot.connect()
    assert anna.start(robot.device, idempotency_key="k").json()["id"] != first


@pytest.mark.parametrize(("delay_ms", "status"), [(ABANDON_MS - 100, 202), (ABANDON_MS + 100, 503)])
def test_a_start_that_takes_too_long_to_write_is_refused(
    cloud: Cloud, anna: Person, robot: Robot, delay_ms: int, status: int
) -> None:
    schedule = cloud.functions.reminders.schedule

    async def slow(*arguments: Any) -> None:
        await schedule(*arguments)
        cloud.clock.advance(delay_ms / 1000)

    with mock.patch.object(cloud.functions.reminders, "schedule", slow):
        answer = anna.start(robot.device)
    assert answer.status_code == status
    if status == 503:
        problem(answer, 503, "busy")
        assert robot.received(MoveJoints) == []
        assert anna.get(f"/devices/{robot.device}/actions").json()["items"] == []


@pytest.mark.parametrize(("how", "status", "code", "why"), [
    ("share", 404, "device-unknown", "unshared"), ("key", 403, "forbidden", "api-key-ended"),
])  # fmt: skip
def test_a_start_whose_permission_ended_while_it_was_written_is_not_sent(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot, how: str, *, status: int, code: str, why: str
) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    key, program = make(anna)
    caller = bert if how == "share" else program
    tables, schedule = cloud.functions.tables, cloud.functions.reminders.schedule

    async def ending(*arguments: Any) -> None:
        await schedule(*arguments)
        if how == "share":
            await records.remove(tables, records.SHARES, f"device:{robot.device}", f"account:{bert.account}")
        else:
            await records.remove(tables, records.API_KEYS, key, "key")

    with mock.patch.object(cloud.functions.reminders, "schedule", ending):
        problem(caller.start(robot.device), status, code)
    assert robot.received(MoveJoints) == []
    (row,) = (data for name, data in control_rows(cloud, robot.device).items() if name.startswith("action:"))
    assert (row["status"], row["reason"]["code"]) == ("failed", why)
    assert anna.start(robot.device, wait_ms=10_000).status_code == 200, "the slot is free"


def test_a_start_whose_permission_ended_is_ended_despite_a_concurrent_write(
    cloud: Cloud, anna: Person, robot: Robot
) -> None:
    tables = cloud.functions.tables

    async def changed_and_ended(*_: Any) -> None:
        page = await tables.query(records.CONTROL, robot.device, first="action:", last="action;")
        await tables.replace(records.CONTROL, page.rows[0].changed({**page.rows[0].data, "output": "x"}))
        raise not_found("device", robot.device)

    with mock.patch.object(cloud.functions.devices, "require_still_allowed", changed_and_ended):
        problem(anna.start(robot.device), 404, "device-unknown")
    (row,) = (data for name, data in control_rows(cloud, robot.device).items() if name.startswith("action:"))
    assert (row["status"], row["output"]) == ("failed", "x")

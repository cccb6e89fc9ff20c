"""A start that is killed after any write leaves nothing open for any report of the robot.

See also tests/integration/kills.
"""

from typing import Any

import pytest

from device_agent.protocol import AckStatus, MoveJoints, RunMovement
from function_app.services.maintenance.scheduler import ORPHAN_MS
from tests.fakes.agent import Robot
from tests.fixtures.cloud import Crashing
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.crash_injection import at_instance
from tests.unit.function_app.services.actions.queue_requests import control_rows, pass_time, reminders

pytestmark = pytest.mark.slow
MAX_WRITES = 60
WAVE = {"request": {"kind": "run_movement", "name": "slow_square", "parameters": {"side_m": 0.1}}}
STARTS = (AckStatus.RECEIVED, AckStatus.STARTED)
ENDS = (*STARTS, AckStatus.DONE)


def check_settled(cloud: Cloud, robot: Robot, anna: Person) -> None:
    """Let time pass and check that nothing is left open."""
    pass_time(cloud, 20)
    for key, data in control_rows(cloud, robot.device).items():
        if key.startswith("action:") and data["status"] == "unknown":
            robot.report(data["id"], AckStatus.FAILED)
    pass_time(cloud, 10 + ORPHAN_MS / 1000, step_s=15)
    pass_time(cloud, 400, step_s=200)
    rows = control_rows(cloud, robot.device)
    actions = {data["id"]: data["status"] for key, data in rows.items() if key.startswith("action:")}
    assert set(actions.values()) <= {"done", "failed", "expired", "cancelled"}
    assert rows.get("now:slot", {"action": ""})["action"] == ""
    assert reminders(cloud) == []
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    for action, payloads in robot.payloads.items():
        assert len(set(payloads)) == 1, "the same command has the same bytes"
        request = next(command.request for command in robot.commands if command.id == action)
        assert action in actions or not isinstance(request, MoveJoints | RunMovement), "sent, but not stored"
    robot.reports = lambda _: ENDS
    assert anna.start(robot.device, wait_ms=10_000, wait_for="done").json()["status"] == "done"


@pytest.mark.parametrize("reports", [(), STARTS, ENDS], ids=["silent", "starts", "ends"])
@pytest.mark.parametrize("request_", [{}, WAVE], ids=["move", "movement"])
def test_start(cloud: Cloud, robot: Robot, crashing: Crashing, reports: Any, request_: dict[str, Any]) -> None:
    for writes in range(1, MAX_WRITES):
        anna = cloud.sign_in("anna")
        robot.reports = lambda _: reports
        process, crash_point = crashing(cloud.clock)
        client = at_instance(process, anna)
        assert client.get("/accounts/me").status_code == 200
        crash_point.left = writes
        options = {
            "idempotency_key": f"k{writes}",
            "wait_ms": 100,
            "wait_for": "done",
            "ttl_ms": 2_000,
            "timeout_ms": 6_000,
        }
        assert (client.start(robot.device, **options, **request_).status_code < 500) is crash_point.survived
        before = set(control_rows(cloud, robot.device))
        assert anna.start(robot.device, **options, **request_).status_code in {200, 202}
        if crash_point.written > 1:
            new = set(control_rows(cloud, robot.device)) - before
            assert not [key for key in new if key.startswith("action:")], "the same key is the same action"
        check_settled(cloud, robot, anna)
        if crash_point.survived:
            assert writes > 3
            return
    pytest.fail(f"a start writes more than {MAX_WRITES} times")

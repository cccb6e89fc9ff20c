"""A tenant sees nothing of another: every route with the other's ids answers as if there were nothing."""

import re
from typing import Any

import pytest

from device_agent.protocol import Fault, Mode, State
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.network.brokers import wait_until

BODIES: dict[str, Any] = {
    "take_lease": {},
    "start_action": {"request": {"kind": "move_joints", "position_rad": {"elbow": 1.0}}},
    "stop_device": {"reason": "x"},
    "put_movement": {"source": "1"},
    "add_latency": {"transport": "http", "path": "device-cloud", "samples": [{"at_ms": 1, "ms": 1}]},
    "add_agent_latency": {
        "device": "arm",
        "transport": "http",
        "path": "device-cloud",
        "samples": [{"at_ms": 1, "ms": 1}],
    },
    "move_agent": {"space": "x"},
    "share_device": {"account": "bert", "role": "operator"},
    "rename_device": {"label": "mine"},
    "share_space": {"account": "bert", "role": "operator"},
    "invite_to_device": {"role": "operator"},
    "invite_to_space": {"role": "operator"},
    "transfer_agent": {},
    "transfer_space": {},
    "post_agent_messages": {"messages": [{"topic": "t", "payload": {}}]},
    "begin_upload": {"stream": "camera", "length": 3, "content_type": "image/png"},
    "begin_agent_upload": {"device": "arm", "stream": "camera", "length": 3, "content_type": "image/png"},
    "complete_agent_upload": {"device": "arm"},
}


def everything(cloud: Cloud) -> list[Any]:
    """Every row there is, except who has tried how often."""
    tables: Any = cloud.functions.tables
    return [(table, row) for table, row in tables.rows() if table != "Attempts"]


@pytest.fixture
def strangers(cloud: Cloud) -> Any:
    """Anna with a robot, a lease and a running action; and Bert with a robot of his own."""
    with paired(cloud, "anna") as (anna, robot), paired(cloud, "bert") as (bert, other):
        epoch = anna.take(robot.device, lease_ms=600_000).json()["epoch"]
        action = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
        anna.put("/robot-types/ur5/movements/secret", {"source": "'anna'"})
        hot = Fault(code="hot", message="Too hot.", since_ms=1)
        state = State(device="arm", at_ms=1, tick_ms=1, mode=Mode.FAULT, epoch=epoch, faults=(hot,))
        robot.say_state(state)
        wait_until(lambda: anna.get(f"/devices/{robot.device}/faults").json()["items"], "the fault")
        yield anna, robot, action, bert, other


def test_every_route_with_the_others_ids_finds_nothing_and_changes_nothing(
    cloud: Cloud, strangers: tuple[Person, Robot, str, Person, Robot]
) -> None:
    anna, robot, action, bert, other = strangers
    capture = {"stream": "camera", "length": 3, "content_type": "image/png"}
    upload = anna.post(f"/devices/{robot.device}/uploads", capture).json()["id"]
    fault = anna.get(f"/devices/{robot.device}/faults").json()["items"][0]["id"]
    request = cloud.sign_in("anna").post(f"/devices/{robot.device}/lease/requests").json()["request"]["id"]
    invitation = anna.post(f"/devices/{robot.device}/invitations", {"role": "operator"}).json()["id"]
    ids = {
        "request_id": request,
        "device": robot.device,
        "agent": robot.id,
        "action": action,
        "robot_type": "ur5",
        "name": "secret",
        "space": robot.space,
        "stream": "joints",
        "fault": fault,
        "upload": upload,
        "account": anna.account,
        "invitation": invitation,
    }
    told = len(robot.commands)
    before = everything(cloud)
    asked = set()
    for path, operations in cloud.app.openapi()["paths"].items():
        if not set(re.findall(r"{(\w+)}", path)) & {"device", "agent", "action", "name", "space"}:
            continue
        for method, operation in operations.items():
            name = operation["operationId"]
            if name == "put_movement":
                continue  # one's own of that name may be made
            where = path.format(**ids).removeprefix("/api/v1") + ("?epoch=1" if name == "release_lease" else "")
            stranger: Person | Robot = other if operation["security"] == [{"agentToken": []}] else bert
            body = {"json": BODIES[name]} if name in BODIES else {}
            answer = stranger.ask(method.upper(), where, **body)
            assert answer.status_code == 404, f"{name}: {answer.status_code} {answer.text}"
            detail = problem(answer, 404, answer.json()["type"].rpartition("/")[2])["detail"]
            assert "anna" not in detail
            asked.add(name)
    assert {
        "get_device",
        "get_lease",
        "take_lease",
        "release_lease",
        "request_control",
        "get_control_request",
        "accept_control_request",
        "reject_control_request",
        "withdraw_control_request",
        "stop_space",
        "start_action",
        "list_actions",
        "get_action",
        "cancel_action",
        "stop_device",
        "reset_stop",
        "unpair_agent",
        "share_device",
        "unshare_device",
        "share_space",
        "unshare_space",
        "invite_to_device",
        "withdraw_space_invitation",
        "transfer_agent",
        "transfer_space",
        "move_agent",
        "fetch_commands",
        "post_agent_messages",
        "get_movement",
        "delete_movement",
    } <= asked
    control = {"purpose": "control", "device": robot.device, "epoch": 1}
    problem(bert.post("/mqtt/credentials", control), 404, "device-unknown")
    assert everything(cloud) == before
    assert len(robot.commands) == told
    assert robot.stops == []


def test_what_is_not_there_is_answered_as_what_is_anothers(
    strangers: tuple[Person, Robot, str, Person, Robot],
) -> None:
    _, robot, action, bert, _ = strangers
    unknown = "zzzzzzzzzz"
    for foreign, missing in (
        (f"/devices/{robot.device}", f"/devices/{unknown}-arm"),
        (f"/actions/{action}", f"/actions/{unknown}-arm-{action[-20:]}"),
        (f"/devices/{robot.device}/actions", f"/devices/{unknown}-arm/actions"),
    ):
        one, two = bert.get(foreign).json(), bert.get(missing).json()
        assert one["detail"].replace(robot.id, unknown) == two["detail"]
        assert {**one, "detail": ""} == {**two, "detail": ""}


def test_lists_hold_ones_own_only(strangers: tuple[Person, Robot, str, Person, Robot]) -> None:
    _, robot, _, bert, other = strangers
    for path in ("/devices", "/agents", "/spaces", "/robot-types/ur5/movements"):
        text = bert.get(path).text
        assert robot.id not in text
        assert robot.space not in text
        assert "secret" not in text
    assert [item["id"] for item in bert.get("/devices").json()["items"]] == [other.device]
    watch = bert.post("/mqtt/credentials", {"purpose": "view"}).json()
    assert not [topic for topic in (*watch["subscribe"], *watch["publish"]) if robot.space in topic]


def test_a_cursor_of_anothers_list_shows_nothing_of_it(
    cloud: Cloud, strangers: tuple[Person, Robot, str, Person, Robot]
) -> None:
    anna, robot, _, bert, other = strangers
    with paired(cloud, "anna") as (again, _):
        cursor = again.get("/devices", params={"limit": 1}).json()["cursor"]
    assert cursor is not None
    found = {item["id"] for item in bert.get("/devices", params={"cursor": cursor}).json()["items"]}
    assert found <= {other.device}
    assert anna.get(f"/devices/{robot.device}").status_code == 200

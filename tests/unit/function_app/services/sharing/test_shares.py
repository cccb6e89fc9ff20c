"""Permissions, expiry and end of shares of devices and spaces."""

from typing import Any

from device_agent.protocol import AckStatus, RunMovement
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.unit.function_app.services.sharing.shares import SHARED_S, devices, share, unshare


def test_an_operator_operates_a_shared_device_without_owner_rights(anna: Person, bert: Person, robot: Robot) -> None:
    shown = share(anna, f"devices/{robot.device}", bert, "operator")
    assert (shown["account"], shown["role"], shown["created_by"]) == (
        {"id": bert.account, "name": "bert"},
        "operator",
        "anna",
    )
    assert shown["expires_at"] is None
    found = bert.get(f"/devices/{robot.device}").json()
    assert (found["role"], found["owner"]) == ("operator", {"id": anna.account, "name": "anna"})
    assert anna.get(f"/devices/{robot.device}").json()["owner"] == {"id": anna.account, "name": "anna"}
    epoch = bert.take_lease(robot.device).json()["epoch"]
    assert bert.start(robot.device, epoch=epoch, wait_ms=10_000).json()["status"] == "started"
    assert bert.post(f"/devices/{robot.device}/stop").status_code == 200
    assert bert.post(f"/devices/{robot.device}/stop/reset").status_code == 200
    problem(bert.take_lease(robot.device, take_over=True, reason="mine"), 403, "forbidden")
    assert bert.get("/agents").json()["items"] == []


def test_a_viewer_can_neither_control_nor_stop(anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "viewer")
    control = {"purpose": "control", "device": robot.device, "epoch": 1}
    problem(bert.post("/mqtt/credentials", control), 403, "forbidden")
    problem(bert.take_lease(robot.device), 403, "forbidden")
    assert bert.post("/stop").json()["items"] == []
    assert (robot.commands, robot.stops) == ([], [])


def test_a_shared_space_includes_current_and_later_devices(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot
) -> None:
    share(anna, f"spaces/{robot.space}", bert, "operator")
    spaces = {item["id"]: (item["role"], item["owner"]["name"]) for item in bert.get("/spaces").json()["items"]}
    assert spaces[robot.space] == ("operator", "anna")
    assert len(spaces) == 2
    with cloud.robot("left", "right") as second:
        second.pair(anna)
        assert devices(bert) == dict.fromkeys([robot.device, *second.devices], "operator")
        stopped = bert.post(f"/spaces/{robot.space}/stop").json()["items"]
        assert {item["device"] for item in stopped} == set(devices(bert))
        assert bert.get(f"/spaces/{robot.space}/diagnostics").status_code == 200
        attic = anna.post("/spaces", {"name": "Attic"}).json()["id"]
        anna.put(f"/agents/{second.id}/space", {"space": attic})
        assert devices(bert) == {robot.device: "operator"}
    problem(bert.post("/agents/claim", {"code": "BBBB-BBBB", "space": robot.space}), 404, "space-unknown")


def test_the_higher_of_two_roles_applies_until_it_expires(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot
) -> None:
    share(anna, f"spaces/{robot.space}", bert, "viewer")
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=SHARED_S)
    assert devices(bert) == {robot.device: "operator"}
    cloud.clock.advance(SHARED_S)
    assert devices(bert) == {robot.device: "viewer"}
    unshare(anna, f"spaces/{robot.space}", bert)
    assert devices(bert) == {}


def test_shared_devices_are_listed_after_own_ones(cloud: Cloud, anna: Person, bert: Person, robot: Robot) -> None:
    with paired(cloud, "bert", "one", "two") as (_, own), paired(cloud, "anna") as (_, second):
        for device in (robot.device, second.device):
            share(anna, f"devices/{device}", bert, "viewer")
        expected = dict.fromkeys(own.devices, "owner") | {robot.device: "viewer", second.device: "viewer"}
        assert devices(bert) == expected
        assert len(bert.each_page("/devices")) == 1
        assert devices(anna) == {robot.device: "owner", second.device: "owner"}


def test_only_the_owners_movements_run_on_a_shared_device(anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    anna.put("/robot-types/ur5/movements/hers", {"source": "'anna'"})
    anna.put("/robot-types/ur5/movements/same", {"source": "'anna'"})
    bert.put("/robot-types/ur5/movements/his", {"source": "'bert'"})
    bert.put("/robot-types/ur5/movements/same", {"source": "'bert'"})

    def run(name: str) -> Any:
        return bert.start(robot.device, request={"kind": "run_movement", "name": name}, wait_ms=10_000)

    for name in ("hers", "same"):
        action = run(name).json()["id"]
        command = robot.received(RunMovement)[-1].request
        assert isinstance(command, RunMovement)
        assert (command.source, command.author) == ("'anna'", anna.account)
        robot.report(action, AckStatus.DONE)
        assert bert.action(action)["status"] == "done"
    problem(run("his"), 404, "movement-unknown")
    at = f"/devices/{robot.device}/movements"
    listed = {item["name"] for item in bert.get(at).json()["items"]}
    assert {"hers", "same"} <= listed
    assert "his" not in listed
    assert bert.get(f"{at}/same").json()["source"] == "'anna'"
    problem(bert.get("/robot-types/ur5/movements/hers"), 404, "movement-unknown")
    share(anna, f"devices/{robot.device}", bert, "viewer")
    problem(bert.get(f"{at}/same"), 403, "forbidden")
    assert bert.get(f"/devices/{robot.device}/robot-type").json()["type"] == "ur5"


def test_a_share_is_changed_listed_and_left(anna: Person, bert: Person, robot: Robot) -> None:
    at = f"/devices/{robot.device}/shares"
    assert anna.post(at, {"account": "bert", "role": "operator"}).status_code == 201
    changed = anna.post(at, {"account": "bert", "role": "viewer", "expires_in_s": SHARED_S})
    assert changed.status_code == 200
    problem(anna.post(at, {"account": "bert", "role": "owner"}), 422, "invalid")
    assert anna.get(at).json() == {"items": [changed.json()], "cursor": None}
    assert bert.delete(f"{at}/{bert.account}").status_code == 204
    assert anna.get(at).json()["items"] == []
    assert devices(bert) == {}
    problem(bert.delete(f"{at}/{bert.account}"), 404, "share-unknown")
    problem(anna.delete(f"{at}/{bert.account}"), 404, "share-unknown")
    kinds = [item["kind"] for item in anna.get(f"/devices/{robot.device}/events").json()["items"]]
    assert kinds.count("shared") == 2
    assert kinds.count("unshared") == 1


def test_unpairing_deletes_all_shares(anna: Person, bert: Person, robot: Robot) -> None:
    share(anna, f"devices/{robot.device}", bert, "operator")
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    assert devices(bert) == {}
    robot.pair(anna)
    assert devices(bert) == {}
    problem(bert.get(f"/devices/{robot.device}"), 404, "device-unknown")
    assert anna.get(f"/devices/{robot.device}/shares").json()["items"] == []
    cloud = anna.cloud
    assert cloud.run(cloud.functions.tables.query(records.SHARES, f"device:{robot.device}")).rows == ()
    index = cloud.run(cloud.functions.tables.query(records.MEMBERS, bert.account, first="share:", last="share;"))
    assert index.rows == ()

"""Devices and spaces shared with other accounts: who may do what, until when, and that ending it ends everything."""

from typing import Any

from device_agent.protocol import AckStatus, RunMovement
from function_app.domain.identity.accounts import Identity, Role
from function_app.services.storage import records
from tests.harness.cloud.cloud import Cloud, paired, problem
from tests.harness.network.brokers import wait_until
from tests.unit.function_app.services.sharing.shares import SHARED_S, Three, devices, share, unshare


def test_an_operator_sees_and_operates_what_is_shared_and_owns_nothing(three: Three) -> None:
    anna, bert, robot = three
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
    epoch = bert.take(robot.device).json()["epoch"]
    assert bert.start(robot.device, epoch=epoch, wait_ms=10_000).json()["status"] == "started"
    assert bert.post(f"/devices/{robot.device}/stop").status_code == 200
    assert bert.post(f"/devices/{robot.device}/stop/reset").status_code == 200
    for method, path, body in (
        ("GET", "shares", None),
        ("POST", "shares", {"account": "anna", "role": "viewer"}),
        ("POST", "lease", {"take_over": True, "reason": "mine"}),
    ):
        problem(bert.ask(method, f"/devices/{robot.device}/{path}", json=body), 403, "forbidden")
    problem(bert.delete(f"/agents/{robot.id}"), 404, "agent-unknown")
    problem(bert.put(f"/agents/{robot.id}/space", {"space": robot.space}), 404, "agent-unknown")
    assert bert.get("/agents").json()["items"] == []


def test_a_viewer_sees_everything_and_changes_nothing(three: Three) -> None:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "viewer")
    at = f"/devices/{robot.device}"
    action = anna.start(robot.device, wait_ms=10_000).json()["id"]
    views = ("", "lease", "actions", "events", "faults", "data", "diagnostics", "latency", "uploads")
    for path in views:
        assert bert.get(f"{at}/{path}".rstrip("/")).status_code == 200, path
    assert bert.get(f"/actions/{action}").json()["status"] == "started"
    told = len(robot.commands)
    samples = [{"at_ms": 1, "ms": 1}]
    for path, body in (
        ("actions", {"request": {"kind": "move_joints", "position_rad": {"elbow": 1.0}}}),
        ("lease", {}),
        ("lease/requests", {}),
        ("stop", {}),
        ("stop/reset", None),
        ("latency", {"transport": "mqtt", "path": "operator-cloud", "samples": samples}),
        ("uploads", {"stream": "camera", "length": 3, "content_type": "image/png"}),
        ("shares", {"account": "anna", "role": "viewer"}),
    ):
        problem(bert.post(f"{at}/{path}", body), 403, "forbidden")
    problem(bert.post(f"/actions/{action}/cancel"), 403, "forbidden")
    problem(
        bert.post("/mqtt/credentials", {"purpose": "control", "device": robot.device, "epoch": 1}), 403, "forbidden"
    )
    assert bert.post("/stop").json()["items"] == []
    assert (len(robot.commands), robot.stops) == (told, [])


def test_a_space_is_shared_with_all_that_is_in_it_and_comes_into_it(cloud: Cloud, three: Three) -> None:
    anna, bert, robot = three
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
    problem(bert.get(f"/spaces/{robot.space}/shares"), 403, "forbidden")


def test_the_higher_of_two_roles_counts_as_long_as_it_lasts(cloud: Cloud, three: Three) -> None:
    anna, bert, robot = three
    share(anna, f"spaces/{robot.space}", bert, "viewer")
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=SHARED_S)
    assert devices(bert) == {robot.device: "operator"}
    cloud.clock.advance(SHARED_S)
    assert devices(bert) == {robot.device: "viewer"}
    unshare(anna, f"spaces/{robot.space}", bert)
    assert devices(bert) == {}


def test_several_operators_reach_one_robot_and_one_operator_several(cloud: Cloud, three: Three) -> None:
    anna, bert, robot = three
    clara = cloud.sign_in("clara")
    for person in (bert, clara):
        share(anna, f"devices/{robot.device}", person, "operator")
    epoch = bert.take(robot.device).json()["epoch"]
    assert problem(clara.take(robot.device), 409, "lease-held")["holder"] == "bert"
    request = clara.post(f"/devices/{robot.device}/lease/requests", {}).json()["request"]["id"]
    given = bert.post(f"/devices/{robot.device}/lease/requests/{request}/accept").json()
    assert given["epoch"] == epoch + 1
    with paired(cloud, "dora") as (dora, other):
        share(dora, f"devices/{other.device}", bert, "operator")
        clara.ask("DELETE", f"/devices/{robot.device}/lease", params={"epoch": epoch + 1})
        body = {"devices": [robot.device, other.device], "request": {"kind": "move_joints", "position_rad": {"a": 1}}}
        items = bert.post("/actions", {**body, "wait_ms": 10_000}).json()["items"]
        assert [item["action"]["status"] for item in items] == ["started", "started"]
        assert devices(bert) == {robot.device: "operator", other.device: "operator"}


def test_a_list_goes_on_behind_ones_own_page_by_page(cloud: Cloud, three: Three) -> None:
    anna, bert, robot = three
    with paired(cloud, "bert", "one", "two") as (_, own), paired(cloud, "anna") as (_, second):
        for device in (robot.device, second.device):
            share(anna, f"devices/{device}", bert, "viewer")
        wanted = dict.fromkeys(own.devices, "owner") | {robot.device: "viewer", second.device: "viewer"}
        assert devices(bert) == wanted
        page = bert.get("/devices").json()
        assert {item["id"]: item["role"] for item in page["items"]} == wanted
        assert page["cursor"] is None
        assert devices(anna) == {robot.device: "owner", second.device: "owner"}


def test_the_owners_movements_run_on_a_shared_device_and_no_others(three: Three) -> None:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "operator")
    anna.put("/robot-types/ur5/movements/hers", {"source": "'anna'"})
    anna.put("/robot-types/ur5/movements/same", {"source": "'anna'"})
    bert.put("/robot-types/ur5/movements/his", {"source": "'bert'"})
    bert.put("/robot-types/ur5/movements/same", {"source": "'bert'"})

    def run(name: str) -> Any:
        return bert.start(robot.device, request={"kind": "run_movement", "name": name}, wait_ms=10_000)

    for name in ("hers", "same"):
        action = run(name).json()["id"]
        command = robot.heard(RunMovement)[-1].request
        assert isinstance(command, RunMovement)
        assert (command.source, command.author) == ("'anna'", anna.account)
        robot.report(action, AckStatus.DONE)
        wait_until(lambda action=action: bert.action(action)["status"] == "done", "its end")  # type: ignore[misc]
    problem(run("his"), 404, "movement-unknown")
    at = f"/devices/{robot.device}/movements"
    listed = {item["name"] for item in bert.get(at).json()["items"]}
    assert {"hers", "same"} <= listed
    assert "his" not in listed
    assert bert.get(f"{at}/same").json()["source"] == "'anna'"
    problem(bert.get("/robot-types/ur5/movements/hers"), 404, "movement-unknown")
    assert bert.put("/robot-types/ur5/movements/hers", {"source": "'mine'"}).status_code == 201
    assert bert.get(f"{at}/hers").json()["source"] == "'anna'", "what he writes is his, and stays with him"
    share(anna, f"devices/{robot.device}", bert, "viewer")
    for path in ("", "/same"):
        problem(bert.get(at + path), 403, "forbidden")
    assert bert.get(f"/devices/{robot.device}/robot-type").json()["type"] == "ur5"
    assert bert.get(f"/devices/{robot.device}/robot-type/files/robot.toml").status_code == 200


def test_what_cannot_be_shared_so(three: Three) -> None:
    anna, _, robot = three
    for on in (f"devices/{robot.device}", f"spaces/{robot.space}"):
        for body, status, code in (
            ({"account": "bert", "role": "owner"}, 422, "invalid"),
            ({"account": "bert", "role": "operator", "expires_in_s": 1}, 422, "invalid"),
            ({"account": "no account", "role": "viewer"}, 404, "account-unknown"),
            ({"account": "anna", "role": "viewer"}, 422, "invalid"),
        ):
            problem(anna.post(f"/{on}/shares", body), status, code)


def test_a_share_is_changed_listed_and_given_back(three: Three) -> None:
    anna, bert, robot = three
    at = f"/devices/{robot.device}/shares"
    assert anna.post(at, {"account": "bert", "role": "operator"}).status_code == 201
    changed = anna.post(at, {"account": "bert", "role": "viewer", "expires_in_s": SHARED_S})
    assert changed.status_code == 200
    assert anna.get(at).json() == {"items": [changed.json()], "cursor": None}
    assert bert.delete(f"{at}/{bert.account}").status_code == 204
    assert anna.get(at).json()["items"] == []
    assert devices(bert) == {}
    problem(bert.delete(f"{at}/{bert.account}"), 404, "share-unknown")
    problem(anna.delete(f"{at}/{bert.account}"), 404, "share-unknown")
    kinds = [item["kind"] for item in anna.get(f"/devices/{robot.device}/events").json()["items"]]
    assert kinds.count("shared") == 2
    assert kinds.count("unshared") == 1


def test_unpairing_ends_every_share_and_pairing_again_restores_none(three: Three) -> None:
    anna, bert, robot = three
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


def test_a_role_and_a_list_of_devices_cap_what_an_identity_may(three: Three) -> None:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "operator")
    find = anna.cloud.functions.devices.find_with_link
    for account, most, only, role in (
        (anna.account, "owner", (), "owner"),
        (anna.account, "operator", (), "operator"),
        (anna.account, "viewer", (f"space:{robot.space}",), "viewer"),
        (anna.account, "owner", (f"{robot.device}x",), None),
        (bert.account, "owner", (robot.device,), "operator"),
        (bert.account, "viewer", (), "viewer"),
        (bert.account, "owner", ("space:x",), None),
    ):
        who = Identity(account, "app", "s", key="k", most=Role(most), only=only)
        found, _ = anna.cloud.run(find(who, robot.device))
        assert (found.role.value if found else None) == role

"""Devices and spaces shared with other accounts: who may do what, until when, and that ending it ends everything."""

from typing import Any, NamedTuple

import pytest

from device_agent.protocol import AckStatus, CancelAction, GrantLease, MoveJoints, ReleaseLease, RunMovement, topics
from function_app.domain.identity.accounts import Identity, Role
from function_app.ports.broker_access import Credentials
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker, MemoryConnection
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.crash_injection import elsewhere
from tests.harness.network.brokers import wait_until

Three = tuple[Person, Person, Robot]
SHARED_S = 120


@pytest.fixture
def three(cloud: Cloud, pair: tuple[Person, Robot]) -> Three:
    """Anna; Bert, with whom nothing is shared; and Anna's robot."""
    anna, robot = pair
    return anna, cloud.sign_in("bert"), robot


def share(owner: Person, on: str, person: Person, role: str, **more: Any) -> dict[str, Any]:
    """Share ``devices/<id>`` or ``spaces/<id>``."""
    answer = owner.post(f"/{on}/shares", {"account": person.name, "role": role, **more})
    assert answer.status_code in {200, 201}, answer.text
    shown: dict[str, Any] = answer.json()
    return shown


def unshare(owner: Person, on: str, person: Person) -> None:
    assert owner.delete(f"/{on}/shares/{person.account}").status_code == 204


def devices(person: Person) -> dict[str, str]:
    """Id → role, over all pages of one agent each."""
    found: dict[str, str] = {}
    cursor: str | None = ""
    while cursor is not None:
        page = person.get("/devices", params={"limit": 1} | ({"cursor": cursor} if cursor else {})).json()
        found |= {item["id"]: item["role"] for item in page["items"]}
        cursor = page["cursor"]
    return found


def watching(broker: MemoryBroker, person: Person) -> tuple[MemoryConnection, dict[str, Any]]:
    issued = person.post("/mqtt/credentials", {"purpose": "view"}).json()
    client = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert client.connected.is_set(), client.answer
    return client, issued


def steering(broker: MemoryBroker, person: Person, device: str, epoch: int) -> MemoryConnection:
    issued = person.post("/mqtt/credentials", {"purpose": "control", "device": device, "epoch": epoch}).json()
    client = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert client.connected.is_set(), client.answer
    return client


# ------------------------------------------------------------ roles


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


# ------------------------------------------------------------ bounds


def test_what_cannot_be_shared_so(three: Three) -> None:
    anna, _, robot = three
    for on in (f"devices/{robot.device}", f"spaces/{robot.space}"):
        for body, status, code in (
            ({"account": "bert", "role": "owner"}, 422, "invalid"),
            ({"account": "bert", "role": "operator", "expires_in_s": 1}, 422, "invalid"),
            ({"account": "nobody here", "role": "viewer"}, 404, "account-unknown"),
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


def test_an_unpaired_agent_is_shared_with_nobody_not_even_when_it_comes_back(three: Three) -> None:
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


# ------------------------------------------------------------ on the broker


def test_watching_a_shared_device_hears_that_device_alone(cloud: Cloud, broker: MemoryBroker, three: Three) -> None:
    anna, bert, robot = three
    with paired(cloud, "anna", "arm", "leg") as (_, second):
        share(anna, f"devices/{second.device}", bert, "operator")
        page, issued = watching(broker, bert)
        base = f"ts/v1/{second.space}/{second.id}/arm"
        spoken = ("desc", "desc/twin", "state", "tele/+", "cam/+", "event", "ack")
        wanted = {topics.conn(second.space, second.id), *(f"{base}/{kind}" for kind in spoken)}
        assert set(issued["subscribe"]) == wanted
        assert issued["publish"] == [f"{base}/stop"]
        with page:
            assert page.subscribe(*issued["subscribe"][:8]) == [1] * 8
            for topic in (f"{base}/#", f"ts/v1/{second.space}/{second.id}/leg/state"):
                assert page.subscribe(topic) == [128], topic
            robot.say(robot.topic(topics.EVENT), {"x": 1})
            second.say(second.topic(topics.EVENT, "leg"), {"x": 2})
            second.say(second.topic(topics.EVENT, "arm"), {"x": 3})
            while (message := page.receive()).topic.endswith("/conn"):
                pass
            assert message.topic == f"{base}/event"
            page.publish(f"{base}/stop", b'{"id":"s1","caller":"bert"}')
            wait_until(lambda: second.stops, "the Stop")


def test_watching_a_shared_space_is_said_by_space(three: Three) -> None:
    anna, bert, robot = three
    for role, stops in (("viewer", 0), ("operator", 1)):
        share(anna, f"spaces/{robot.space}", bert, role, expires_in_s=60)
        issued = bert.post("/mqtt/credentials", {"purpose": "view"}).json()
        assert f"ts/v1/{robot.space}/{robot.id}/arm/state" in issued["subscribe"]
        assert len(issued["publish"]) == stops
        assert 50 <= issued["lifetime_s"] <= 60, "credentials end with the share"


def test_more_devices_than_fit_into_one_grant_are_left_out(cloud: Cloud, broker: MemoryBroker, three: Three) -> None:
    anna, bert, _ = three
    with cloud.robot(*(f"device-with-a-long-name-{n:02d}" for n in range(30))) as many:
        many.pair(anna)
        for device in many.devices:
            share(anna, f"devices/{device}", bert, "operator")
        page, issued = watching(broker, bert)
        page.close()
        assert 10 <= len(issued["publish"]) < 30
        share(anna, f"spaces/{many.space}", bert, "viewer")
        heard = bert.post("/mqtt/credentials", {"purpose": "view"}).json()["subscribe"]
        assert sum(topic.endswith("/state") for topic in heard) == 31


# ------------------------------------------------------------ the end of it


class Busy(NamedTuple):
    """Bert operates Anna's robot: a lease, a running action and one that waits."""

    anna: Person
    bert: Person
    robot: Robot
    epoch: int
    running: str
    waiting: str


@pytest.fixture
def busy(three: Three) -> Busy:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=SHARED_S)
    epoch = bert.take(robot.device, lease_ms=600_000).json()["epoch"]
    running = bert.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
    waiting = bert.start(robot.device, epoch=epoch, policy="queue").json()["id"]
    return Busy(anna, bert, robot, epoch, running, waiting)


def expect_the_end(busy: Busy) -> None:
    anna, bert, robot, epoch, running, waiting = busy
    for action in (running, waiting):
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", "unshared")
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert [command.epoch for command in robot.heard(ReleaseLease)] == [epoch + 1], "the epoch is burned"
    assert [command.request.action for command in robot.heard(CancelAction)] == [running]  # type: ignore[union-attr]
    assert [command.id for command in robot.heard(MoveJoints)] == [running]
    problem(bert.take(robot.device, epoch=epoch), 404, "device-unknown")
    problem(bert.start(robot.device, epoch=epoch), 404, "device-unknown")
    assert anna.take(robot.device).json()["epoch"] == epoch + 2
    kinds = [item["kind"] for item in anna.get(f"/devices/{robot.device}/events").json()["items"]]
    assert {"control-ended", "unshared"} <= set(kinds)


def test_unsharing_ends_lease_actions_and_broker_sessions_at_once(broker: MemoryBroker, busy: Busy) -> None:
    anna, bert, robot, epoch, *_ = busy
    page, _ = watching(broker, bert)
    hers, _ = watching(broker, anna)
    with page, hers, steering(broker, bert, robot.device, epoch) as stick:
        unshare(anna, f"devices/{robot.device}", bert)
        for client in (page, stick):
            wait_until(client.disconnected.is_set, "the cut")
        assert not hers.disconnected.is_set()
    expect_the_end(busy)


def test_the_end_of_its_time_ends_it_the_same_way(broker: MemoryBroker, busy: Busy) -> None:
    anna, bert, robot, epoch, *_ = busy
    page, _ = watching(broker, bert)
    cloud = anna.cloud
    with page, steering(broker, bert, robot.device, epoch) as stick:
        cloud.clock.advance(SHARED_S)
        problem(bert.get(f"/devices/{robot.device}"), 404, "device-unknown")
        cloud.sweep()
        for client in (page, stick):
            wait_until(client.disconnected.is_set, "the cut")
    kinds = [item["kind"] for item in anna.get(f"/devices/{robot.device}/events").json()["items"]]
    assert "unshared" in kinds
    assert [anna.action(action)["reason"]["code"] for action in (busy.running, busy.waiting)] == ["unshared"] * 2


def test_a_share_that_is_extended_at_its_very_end_goes_on(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, three: Three
) -> None:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=SHARED_S)
    cloud.clock.advance(SHARED_S)
    sharing, who = cloud.functions.sharing, Identity(anna.account, anna.name, anna.session)
    real = sharing._reminders.schedule
    times = 0

    async def meanwhile(what: str, due_ms: int) -> Any:
        nonlocal times
        times += 1
        if times == 1:
            shared = await sharing.of(who, "device", robot.device)
            await sharing.put(who, shared, await sharing.person("bert"), Role.OPERATOR, None)
        return await real(what, due_ms)

    monkeypatch.setattr(sharing._reminders, "schedule", meanwhile)
    cloud.sweep()
    assert times > 1
    assert devices(bert) == {robot.device: "operator"}


def test_less_than_before_ends_what_is_over_the_new_role(broker: MemoryBroker, busy: Busy) -> None:
    anna, bert, robot, epoch, running, waiting = busy
    page, _ = watching(broker, bert)
    with page, steering(broker, bert, robot.device, epoch) as stick:
        share(anna, f"devices/{robot.device}", bert, "viewer")
        for client in (page, stick):
            wait_until(client.disconnected.is_set, "the cut")
    assert bert.action(running)["reason"]["code"] == "unshared"
    assert bert.action(waiting)["reason"]["code"] == "unshared"
    problem(bert.take(robot.device), 403, "forbidden")
    assert devices(bert) == {robot.device: "viewer"}


def test_who_may_operate_by_another_share_goes_on(busy: Busy) -> None:
    anna, bert, robot, epoch, running, _ = busy
    share(anna, f"spaces/{robot.space}", bert, "operator")
    unshare(anna, f"devices/{robot.device}", bert)
    assert bert.take(robot.device, epoch=epoch).json()["epoch"] == epoch
    assert bert.action(running)["status"] == "started"
    assert robot.heard(ReleaseLease) == []
    unshare(anna, f"spaces/{robot.space}", bert)
    expect_the_end(busy)


def test_unsharing_takes_nothing_from_anybody_else(cloud: Cloud, three: Three, broker: MemoryBroker) -> None:
    anna, bert, robot = three
    clara = cloud.sign_in("clara")
    for person in (bert, clara):
        share(anna, f"devices/{robot.device}", person, "operator")
    with paired(cloud, "bert") as (again, own):
        mine = again.take(own.device).json()["epoch"]
        epoch = clara.take(robot.device, lease_ms=600_000).json()["epoch"]
        page, _ = watching(broker, clara)
        with page, steering(broker, again, own.device, mine) as stick:
            unshare(anna, f"devices/{robot.device}", bert)
            assert clara.take(robot.device, epoch=epoch).json()["epoch"] == epoch
            assert not page.disconnected.is_set()
            assert not stick.disconnected.is_set(), "his own robot follows him on"
    assert robot.heard(ReleaseLease) == []


def test_a_lease_is_not_granted_for_longer_than_the_share(three: Three) -> None:
    anna, bert, robot = three
    share(anna, f"devices/{robot.device}", bert, "operator", expires_in_s=60)
    assert bert.take(robot.device, lease_ms=600_000).json()["lease_ms"] <= 60_000
    (grant,) = robot.heard(GrantLease)
    assert isinstance(grant.request, GrantLease)
    assert grant.request.lease_ms <= 60_000


def test_what_the_broker_could_not_be_told_the_timer_tells_it(
    cloud: Cloud, open_cloud: Any, broker: MemoryBroker, busy: Busy
) -> None:
    anna, bert, robot, epoch, *_ = busy
    away = elsewhere(open_cloud(clock=cloud.clock), anna)
    page, _ = watching(broker, bert)
    with page, steering(broker, bert, robot.device, epoch) as stick:
        broker.reachable = False
        assert away.delete(f"/devices/{robot.device}/shares/{bert.account}").status_code == 202
        broker.reachable = True
        assert not page.disconnected.is_set()
        cloud.clock.advance(11)
        cloud.sweep()
        for client in (page, stick):
            wait_until(client.disconnected.is_set, "the cut")
    wait_until(lambda: robot.heard(ReleaseLease), "the end of control")
    assert robot.heard(ReleaseLease)[-1].epoch == epoch + 1

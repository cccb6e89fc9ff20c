"""Sharing by link, and transfer of an agent or a space to an account that accepts it."""

from typing import Any

import pytest

from device_agent.protocol import ReleaseLease
from function_app.services.pairing.offboarding import CHECK_MS
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fixtures.cloud import Crashing
from tests.harness.cloud.cloud import Cloud, Person, paired, problem
from tests.harness.cloud.memory import Memory
from tests.harness.crash_injection import at_instance
from tests.unit.function_app.services.sharing.shares import devices

DAY_S = 86_400


def invite(owner: Person, path: str, **body: Any) -> dict[str, Any]:
    answer = owner.post(path, body)
    assert answer.status_code == 201, answer.text
    assert answer.headers["cache-control"] == "no-store"
    made: dict[str, Any] = answer.json()
    return made


def redeem(person: Person, made: dict[str, Any], **more: Any) -> Any:
    return person.post("/invitations/redeem", {"secret": made["secret"], **more})


def test_a_link_grants_the_share_to_the_first_account(
    cloud: Cloud, memory: Memory, anna: Person, bert: Person, robot: Robot
) -> None:
    at = f"/devices/{robot.device}/invitations"
    made = invite(anna, at, role="operator", share_s=600)
    assert made["link"].endswith(f"/#invitation={made['secret']}")
    shown = {name: made[name] for name in made if name not in {"secret", "link"}}
    assert anna.get(at).json() == {"items": [shown], "cursor": None}
    assert bert.post("/invitations/lookup", {"secret": made["secret"]}).json() == shown
    assert (shown["kind"], shown["target"], shown["created_by"], shown["uses"]) == ("device", robot.device, "anna", 1)
    assert redeem(bert, made).json() == shown
    assert devices(bert) == {robot.device: "operator"}
    (share,) = anna.get(f"/devices/{robot.device}/shares").json()["items"]
    assert share["account"]["name"] == "bert"
    assert share["expires_at"] is not None
    assert anna.get(at).json()["items"] == []
    problem(redeem(cloud.sign_in("clara"), made), 404, "invitation-unknown")
    assert made["secret"] not in str(memory.tables.rows())


def test_a_link_with_several_uses_grants_each_account_one_share(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot
) -> None:
    made = invite(anna, f"/spaces/{robot.space}/invitations", role="viewer", uses=2)
    for person in (bert, cloud.sign_in("clara")):
        assert redeem(person, made).status_code == 200
        assert devices(person) == {robot.device: "viewer"}
    problem(redeem(cloud.sign_in("dora"), made), 404, "invitation-unknown")
    again = invite(anna, f"/spaces/{robot.space}/invitations", role="viewer", uses=2)
    assert redeem(bert, again).status_code == 200
    assert anna.delete(f"/spaces/{robot.space}/shares/{bert.account}").status_code == 204
    problem(redeem(bert, again), 404, "invitation-unknown")
    assert devices(bert) == {}, "a removed account cannot use the same link again"


def test_a_link_does_not_reduce_an_existing_share(anna: Person, bert: Person, robot: Robot) -> None:
    assert anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "operator"}).status_code == 201
    made = invite(anna, f"/devices/{robot.device}/invitations", role="viewer", share_s=60)
    assert redeem(bert, made).status_code == 200
    (share,) = anna.get(f"/devices/{robot.device}/shares").json()["items"]
    assert (share["role"], share["expires_at"]) == ("operator", None)


def test_expired_withdrawn_foreign_and_void_links_are_refused(
    cloud: Cloud, memory: Memory, anna: Person, bert: Person, robot: Robot
) -> None:
    at = f"/devices/{robot.device}/invitations"
    late, back, hers, void = (
        invite(anna, at, role="viewer", **more)
        for more in ({"expires_in_s": 60}, {}, {"account": "anna"}, {"expires_in_s": 600})
    )
    problem(redeem(bert, hers), 403, "forbidden")
    problem(redeem(anna, back), 409, "already-owner")
    assert anna.delete(f"{at}/{back['id']}").status_code == 204
    problem(anna.delete(f"{at}/{back['id']}"), 404, "invitation-unknown")
    cloud.clock.advance(60)
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    robot.pair(anna)
    for made in (late, back, void, {"secret": "guess"}):
        error = problem(redeem(bert, made), 404, "invitation-unknown")
        assert error == problem(bert.post("/invitations/lookup", {"secret": made["secret"]}), 404, "invitation-unknown")
    assert devices(bert) == {}
    cloud.clock.advance(DAY_S)
    for _ in range(3):
        cloud.sweep()
    assert memory.tables.rows("Invitations") == [], "expired invitations are deleted"


@pytest.mark.parametrize("transfer", [False, True])
def test_one_of_several_concurrent_redemptions_succeeds(
    cloud: Cloud, anna: Person, robot: Robot, *, transfer: bool
) -> None:
    path = f"/agents/{robot.id}/transfers" if transfer else f"/devices/{robot.device}/invitations"
    made = invite(anna, path, **({} if transfer else {"role": "operator"}))
    people = [cloud.sign_in(f"guest {n}") for n in range(8)]
    waiting = [each.begin("POST", "/invitations/redeem", json={"secret": made["secret"]}) for each in people]
    assert sorted(call().status_code for call in waiting) == [200] + [404] * 7
    assert sorted(len(devices(person)) for person in people) == [0] * 7 + [1]
    assert len(devices(anna)) == (not transfer)


def test_a_transferred_agent_ends_shares_leases_and_actions_of_the_former_owner(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot
) -> None:
    clara = cloud.sign_in("clara")
    anna.post(f"/devices/{robot.device}/shares", {"account": "clara", "role": "operator"})
    epoch = anna.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
    running = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
    made = invite(anna, f"/agents/{robot.id}/transfers", account="bert")
    assert (made["kind"], made["role"]) == ("agent", "owner")
    assert len(anna.get(f"/agents/{robot.id}/transfers").json()["items"]) == 1
    assert devices(bert) == {}, "a transfer has no effect before it is accepted"
    problem(redeem(clara, made), 403, "forbidden")
    link = robot.link
    assert link is not None
    assert redeem(bert, made).status_code == 200
    assert link.disconnected.is_set()
    assert (devices(anna), devices(bert), devices(clara)) == ({}, {robot.device: "owner"}, {})
    assert robot.received(ReleaseLease)[-1].epoch == epoch + 1
    found = bert.get(f"/devices/{robot.device}").json()
    assert (found["state"], found["lease"], found["owner"]["name"]) == (None, None, "bert")
    assert bert.get(f"/devices/{robot.device}/actions").json()["items"] == []
    for person in (bert, anna):
        problem(person.get(f"/actions/{running}"), 404, "action-unknown")
    assert [item["space"] for item in bert.get("/agents").json()["items"]] == [found["space"]]
    assert robot.enrollment()["account"]["name"] == "bert"
    robot.space = found["space"]
    robot.connect()
    assert bert.take_lease(robot.device).json()["epoch"] == epoch + 2
    problem(redeem(bert, made), 404, "invitation-unknown")
    assert anna.get("/agents").json()["items"] == []


def test_a_transferred_space_contains_all_its_agents(cloud: Cloud, anna: Person, bert: Person, robot: Robot) -> None:
    clara = cloud.sign_in("clara")
    attic = anna.post("/spaces", {"name": "Attic"}).json()["id"]
    with paired(cloud, "anna", "left", "right") as (_, second):
        for agent in (robot, second):
            anna.put(f"/agents/{agent.id}/space", {"space": attic})
        anna.post(f"/spaces/{attic}/shares", {"account": "clara", "role": "viewer"})
        made = invite(anna, f"/spaces/{attic}/transfers")
        assert redeem(bert, made).status_code == 200
        assert devices(bert) == dict.fromkeys([robot.device, *second.devices], "owner")
        assert (devices(anna), devices(clara)) == ({}, {})
        spaces = {item["name"]: item["id"] for item in bert.get("/spaces").json()["items"]}
        assert set(spaces) == {"Home", "Attic"}
        assert spaces["Attic"] != attic
        assert {item["space"] for item in bert.get("/devices").json()["items"]} == {spaces["Attic"]}
        assert [item["name"] for item in anna.get("/spaces").json()["items"]] == ["Home"]
        assert [item["name"] for item in clara.get("/spaces").json()["items"]] == ["Home"]


def test_transfers_of_a_space_are_listed_separately_with_the_invited_account(
    anna: Person, bert: Person, robot: Robot
) -> None:
    anna.post("/spaces", {"name": "Attic"})
    offers, links = f"/spaces/{robot.space}/transfers", f"/spaces/{robot.space}/invitations"
    share = invite(anna, links, role="viewer")
    made, open_to_all = invite(anna, offers, account="bert"), invite(anna, offers)
    listed = anna.get(offers).json()["items"]
    assert [(item["id"], item["role"]) for item in listed] == [(made["id"], "owner"), (open_to_all["id"], "owner")]
    assert [item["account"] and item["account"]["name"] for item in listed] == ["bert", None]
    assert all("secret" not in item for item in listed)
    assert [item["id"] for item in anna.get(links).json()["items"]] == [share["id"]]
    assert bert.post("/invitations/lookup", {"secret": open_to_all["secret"]}).json()["account"] is None
    assert anna.delete(f"{offers}/{made['id']}").status_code == 204
    assert [item["id"] for item in anna.get(offers).json()["items"]] == [open_to_all["id"]]
    problem(redeem(bert, made), 404, "invitation-unknown")


@pytest.mark.parametrize("after", [1, 5, 9, 17])
def test_an_acceptance_killed_after_any_write_is_completed_by_the_timer(
    cloud: Cloud, anna: Person, bert: Person, robot: Robot, crashing: Crashing, *, after: int
) -> None:
    attic = anna.post("/spaces", {"name": "Attic"}).json()["id"]
    assert anna.put(f"/agents/{robot.id}/space", {"space": attic}).status_code == 200
    made = invite(anna, f"/spaces/{attic}/transfers")
    process, crash = crashing(cloud.clock)
    client = at_instance(process, bert)
    assert client.get("/accounts/me").status_code == 200
    crash.left = after
    client.post("/invitations/redeem", {"secret": made["secret"]})
    cloud.clock.advance(11)
    cloud.sweep()
    cloud.clock.advance(CHECK_MS / 1000 + 61)
    cloud.sweep()
    if devices(anna):
        assert after <= 5, "only before the accepting write"
        assert redeem(bert, made).status_code == 200
    assert (devices(anna), devices(bert)) == ({}, {robot.device: "owner"})
    assert [item["name"] for item in bert.get("/spaces").json()["items"]] == ["Home", "Attic"]
    assert cloud.run(cloud.functions.tables.query(records.SHARES, f"space:{attic}")).rows == ()

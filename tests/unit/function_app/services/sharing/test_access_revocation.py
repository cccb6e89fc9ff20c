"""Actions, credentials and leases end with the API key, share or session that permits them."""

from dataclasses import replace
from typing import Any

import pytest

from device_agent.protocol import AckStatus, CancelAction, GrantLease, MoveJoints, ReleaseLease
from function_app.domain.actions.action import Status
from function_app.domain.devices.access import Share
from function_app.domain.identity.accounts import Role
from function_app.domain.identity.api_keys import ApiKey
from function_app.services.identity.authenticator import SESSION_S
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import API, Cloud, Person, problem
from tests.unit.function_app.services.accounts.test_api_keys import KEYS, Program, make
from tests.unit.function_app.services.sharing.shares import connected

DAY_S = 86_400


def edit(cloud: Cloud, table: str, place: tuple[str, str], kind: type[Any], **changes: Any) -> None:
    """Change a stored record directly."""
    tables = cloud.functions.tables
    row = cloud.run(tables.get(table, *place))
    assert row is not None
    cloud.run(tables.replace(table, replace(row, data=records.to_data(replace(records.read(row, kind), **changes)))))


class TestQueuedActions:
    """Permissions change while an action is queued."""

    @pytest.mark.parametrize(
        ("how", "why"),
        [
            ("key revoked", "api-key-ended"), ("key expired", "api-key-ended"), ("key of viewer", "api-key-ended"),
            ("key for other device", "api-key-ended"), ("share expired", "unshared"), ("share of viewer", "unshared"),
            ("signed out", "signed-out"),
        ],
    )  # fmt: skip
    def test_a_queued_action_fails_after_its_caller_lost_permission(
        self, cloud: Cloud, anna: Person, bert: Person, robot: Robot, how: str, *, why: str
    ) -> None:
        now_ms = cloud.clock.now_ms()
        key, program = make(anna, days=1)
        other = cloud.sign_in("anna")
        anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "operator", "expires_in_s": 600})
        share = f"device:{robot.device}", f"account:{bert.account}"
        # Changed in the tables: the state before the timer runs, or after a killed request.
        changes: dict[str, tuple[Person, Any]] = {
            "key revoked": (program, lambda: anna.delete(f"{KEYS}/{key}")),
            "key expired": (program, lambda: edit(cloud, records.API_KEYS, (key, "key"), ApiKey, expires_ms=now_ms)),
            "key of viewer": (program, lambda: edit(cloud, records.API_KEYS, (key, "key"), ApiKey, most=Role.VIEWER)),
            "key for other device": (program, lambda: edit(cloud, records.API_KEYS, (key, "key"), ApiKey, only=("x",))),
            "share expired": (bert, lambda: edit(cloud, records.SHARES, share, Share, expires_ms=now_ms)),
            "share of viewer": (bert, lambda: edit(cloud, records.SHARES, share, Share, role=Role.VIEWER)),
            "signed out": (other, lambda: other.post("/auth/sign-out")),
        }
        starter, change = changes[how]
        running = anna.start(robot.device, wait_ms=10_000).json()["id"]
        waiting = starter.start(robot.device, policy="queue").json()["id"]
        assert anna.action(waiting)["status"] == "queued"
        change()
        behind = anna.start(robot.device, policy="queue").json()["id"]
        robot.report(running, AckStatus.DONE)
        ended = anna.action(waiting, wait_ms=20_000)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", why)
        assert ended["reason"]["message"].endswith(".")
        assert anna.action(behind, wait_ms=20_000, wait_for="started")["status"] == "started"
        assert [command.id for command in robot.received(MoveJoints)] == [running, behind]

    def test_a_command_of_a_revoked_key_is_not_resent_while_the_device_would_start_it(
        self, cloud: Cloud, anna: Person, robot: Robot
    ) -> None:
        _, program = make(anna)
        robot.silent = True
        action = program.start(robot.device, ttl_ms=5_000).json()["id"]
        tables: Any = cloud.functions.tables
        tables.drop("ApiKeys")
        for _ in range(4):
            cloud.clock.advance(1.1)
            cloud.sweep()
        assert anna.action(action)["status"] == "unknown", "the device may have executed it"
        assert len(robot.payloads[action]) == 1
        assert robot.received(CancelAction), "an unexpired command would be started, so it is cancelled"
        robot.forget(action)
        robot.silent = False
        cloud.clock.advance(4)
        cloud.sweep()
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", "api-key-ended")

    def test_an_unpublished_command_of_a_revoked_key_never_starts(
        self, cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
    ) -> None:
        _, program = make(anna)
        broker.reachable = False
        action = program.start(robot.device).json()["id"]
        broker.reachable = True
        tables: Any = cloud.functions.tables
        tables.drop("ApiKeys")
        cloud.clock.advance(2)
        cloud.sweep()
        assert action not in robot.payloads
        cloud.clock.advance(10)
        cloud.sweep()
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", "api-key-ended")

    def test_a_command_of_a_revoked_key_that_the_device_has_executed_is_done(
        self, cloud: Cloud, anna: Person, robot: Robot
    ) -> None:
        """The request that has sent it has not recorded this yet: it waits for the robot."""
        _, program = make(anna)
        robot.silent = True
        action = program.start(robot.device, ttl_ms=5_000).json()["id"]
        store = cloud.functions.action_store
        cloud.run(store.change(action, lambda stored: replace(stored, status=Status.CREATED, times={})))
        tables: Any = cloud.functions.tables
        tables.drop("ApiKeys")
        cloud.clock.advance(2)
        cloud.sweep()
        robot.report(action, AckStatus.DONE)
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]) == ("done", None)


class TestGrants:
    """Credentials, tokens and leases."""

    def test_they_expire_with_the_api_key(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        _, program = make(anna, days=1)
        cloud.clock.advance(DAY_S - 45)
        self.check_lifetimes(program, robot)

    def test_they_expire_with_the_session(self, cloud: Cloud, robot: Robot) -> None:
        page = cloud.client()
        signed_in = cloud.run(page.post(f"{API}/auth/sign-in", json={"link": cloud.link("anna")})).json()
        csrf = {"X-CSRF-Token": cloud.run(page.get(f"{API}/accounts/me")).json()["csrf_token"]}
        cloud.clock.advance(SESSION_S - 45)
        token = cloud.run(page.post(f"{API}/auth/token", headers=csrf)).json()
        assert 0 < token["expires_in_s"] <= 45
        late = Program(cloud, token["access_token"])
        self.check_lifetimes(late, robot)
        assert signed_in["account"]["name"] == "anna"
        cloud.clock.advance(45)
        problem(late.get("/devices"), 401, "unauthorized")

    def test_they_expire_with_the_share(self, cloud: Cloud, anna: Person, bert: Person, robot: Robot) -> None:
        anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "operator", "expires_in_s": 60})
        cloud.clock.advance(15)
        self.check_lifetimes(bert, robot)

    def check_lifetimes(self, person: Person, robot: Robot) -> None:
        taken = person.take_lease(robot.device, lease_ms=600_000).json()
        granted: Any = robot.received(GrantLease)[-1].request
        assert max(taken["lease_ms"], granted.lease_ms) <= 45_000
        control = {"purpose": "control", "device": robot.device, "epoch": taken["epoch"]}
        for purpose in ({"purpose": "view"}, control):
            assert 0 < person.post("/mqtt/credentials", purpose).json()["lifetime_s"] <= 45, purpose

    def test_an_expired_key_loses_connections_and_lease(
        self, cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
    ) -> None:
        _, program = make(anna, days=1)
        cloud.clock.advance(DAY_S - 600)
        anna = cloud.sign_in("anna")
        epoch = program.take_lease(robot.device, lease_ms=600_000).json()["epoch"]
        connections = [
            connected(broker, anna),
            connected(broker, program),
            connected(broker, program, "control", device=robot.device, epoch=epoch),
        ]
        cloud.clock.advance(600)
        cloud.sweep()
        assert [each.disconnected.is_set() for each in connections] == [False, True, True]
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None

    def test_an_action_of_a_key_ends_when_the_key_expires(self, cloud: Cloud, anna: Person, robot: Robot) -> None:
        _, program = make(anna, days=1)
        cloud.clock.advance(DAY_S - 60)
        anna = cloud.sign_in("anna")
        program.start(robot.device, timeout_ms=3_600_000, wait_ms=10_000)
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is not None
        cloud.clock.advance(60)
        cloud.sweep()
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
        assert robot.received(ReleaseLease)


@pytest.mark.parametrize("what", ["credentials", "control", "action"])
def test_requests_of_a_key_that_is_revoked_concurrently_are_refused(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    key, program = make(anna)
    devices, tables = cloud.functions.devices, cloud.functions.tables
    name = "require_key" if what == "credentials" else "require_still_allowed"
    real = getattr(devices, name)

    async def meanwhile(*arguments: Any) -> Any:
        # A revocation whose search for active permissions was completed before this request.
        row = await tables.get(records.API_KEYS, key, "key")
        if row is not None:
            await tables.delete(records.API_KEYS, row)
        return await real(*arguments)

    monkeypatch.setattr(devices, name, meanwhile)
    answer = {
        "credentials": lambda: program.post("/mqtt/credentials", {"purpose": "view"}),
        "control": lambda: program.take_lease(robot.device),
        "action": lambda: program.start(robot.device),
    }[what]()
    assert "API key" in problem(answer, 403, "forbidden")["detail"]
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert robot.received(MoveJoints) == []

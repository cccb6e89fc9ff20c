"""What was given or asked for by a key, a share or a session ends with it: in the queue, at the broker, everywhere."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from device_agent.protocol import AckStatus, MoveJoints, ReleaseLease
from function_app.domain.devices.access import Share
from function_app.domain.identity.accounts import Role
from function_app.domain.identity.api_keys import ApiKey
from function_app.ports.broker_access import Credentials
from function_app.services.identity.authenticator import SESSION_S
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import API, Cloud, Person, problem
from tests.harness.network.brokers import wait_until
from tests.unit.function_app.services.accounts.test_api_keys import KEYS, Program, make

Pair = tuple[Person, Robot]
DAY_S = 86_400
ASKED = {"policy": "queue"}


def edit(cloud: Cloud, table: str, place: tuple[str, str], kind: type[Any], **changes: Any) -> None:
    """Change a stored record directly, as no request can."""
    tables = cloud.functions.tables
    row = cloud.run(tables.get(table, *place))
    assert row is not None
    cloud.run(tables.replace(table, replace(row, data=records.to_data(replace(records.read(row, kind), **changes)))))


class TestItsTurn:
    """An action waits; what its starter may do changes; then its turn comes."""

    def expect_no_turn(self, pair: Pair, starter: Person, change: Callable[[str], Any], why: str) -> None:
        anna, robot = pair
        running = anna.start(robot.device, wait_ms=10_000).json()["id"]
        waiting = starter.start(robot.device, **ASKED).json()["id"]
        assert anna.action(waiting)["status"] == "queued"
        change(waiting)
        behind = anna.start(robot.device, **ASKED).json()["id"]
        robot.report(running, AckStatus.DONE)
        ended = anna.action(waiting, wait_ms=20_000)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", why)
        assert ended["reason"]["message"].endswith(".")
        # Who waits behind it has begun nothing wrong.
        assert anna.action(behind, wait_ms=20_000, wait_for="started")["status"] == "started"
        assert [command.id for command in robot.heard(MoveJoints)] == [running, behind]

    @pytest.mark.parametrize("how", ["revoked", "expired", "viewer", "elsewhere"])
    def test_an_action_of_a_key_that_has_ended_or_may_do_less_never_begins(
        self, cloud: Cloud, pair: Pair, how: str
    ) -> None:
        anna, _ = pair
        key, program = make(anna, days=1)

        def change(_: str) -> None:
            place = (key, "key")
            if how == "revoked":
                assert anna.delete(f"{KEYS}/{key}").status_code == 204
            elif how == "expired":
                edit(cloud, records.API_KEYS, place, ApiKey, expires_ms=cloud.clock.now_ms())
            elif how == "viewer":
                edit(cloud, records.API_KEYS, place, ApiKey, most=Role.VIEWER)
            else:
                edit(cloud, records.API_KEYS, place, ApiKey, only=("aaaaaaaaaa-leg",))

        self.expect_no_turn(pair, program, change, "api-key-ended")

    @pytest.mark.parametrize("how", ["over", "viewer"])
    def test_nor_does_one_of_a_share_that_is_over_or_a_viewers(self, cloud: Cloud, pair: Pair, how: str) -> None:
        anna, robot = pair
        bert = cloud.sign_in("bert")
        place = f"device:{robot.device}", f"account:{bert.account}"
        anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "operator", "expires_in_s": 600})

        def change(_: str) -> None:
            # Before the timer has seen to it, and as if who un-shared had been killed.
            if how == "over":
                edit(cloud, records.SHARES, place, Share, expires_ms=cloud.clock.now_ms())
            else:
                edit(cloud, records.SHARES, place, Share, role=Role.VIEWER)

        self.expect_no_turn(pair, bert, change, "unshared")

    def test_nor_does_one_of_a_signed_out_session(self, cloud: Cloud, pair: Pair) -> None:
        other = cloud.sign_in("anna")
        sign_out = lambda _: other.post("/auth/sign-out")  # noqa: E731
        self.expect_no_turn(pair, other, sign_out, "signed-out")

    def test_a_command_that_was_sent_is_not_sent_again_for_a_key_that_was_revoked(
        self, cloud: Cloud, pair: Pair
    ) -> None:
        anna, robot = pair
        _, program = make(anna)
        robot.silent = True
        action = program.start(robot.device).json()["id"]
        wait_until(lambda: robot.heard(MoveJoints), "the command")
        tables: Any = cloud.functions.tables
        tables.drop("ApiKeys")
        cloud.clock.advance(2)
        cloud.sweep()
        ended = anna.action(action)
        assert (ended["status"], ended["reason"]["code"]) == ("failed", "api-key-ended")
        assert len(robot.payloads[action]) == 1


class TestGiven:
    """Credentials, tokens and control."""

    def test_nothing_that_a_key_is_given_lasts_longer_than_the_key(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        _, program = make(anna, days=1)
        cloud.clock.advance(DAY_S - 45)
        self.expect_short(program, robot)

    def test_nor_longer_than_the_session(self, cloud: Cloud, pair: Pair) -> None:
        _, robot = pair
        page = cloud.client()
        signed_in = cloud.run(page.post(f"{API}/auth/sign-in", json={"link": cloud.link("anna")})).json()
        csrf = {"X-CSRF-Token": cloud.run(page.get(f"{API}/accounts/me")).json()["csrf_token"]}
        cloud.clock.advance(SESSION_S - 45)
        token = cloud.run(page.post(f"{API}/auth/token", headers=csrf)).json()
        assert 0 < token["expires_in_s"] <= 45
        late = Program(cloud, token["access_token"])
        self.expect_short(late, robot)
        assert signed_in["account"]["name"] == "anna"
        cloud.clock.advance(45)
        problem(late.get("/devices"), 401, "unauthorized")

    def test_nor_longer_than_the_share(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        bert = cloud.sign_in("bert")
        anna.post(f"/devices/{robot.device}/shares", {"account": "bert", "role": "operator", "expires_in_s": 60})
        cloud.clock.advance(15)
        self.expect_short(bert, robot)

    def expect_short(self, person: Person, robot: Robot) -> None:
        taken = person.take(robot.device, lease_ms=600_000).json()
        assert taken["lease_ms"] <= 45_000
        control = {"purpose": "control", "device": robot.device, "epoch": taken["epoch"]}
        for purpose in ({"purpose": "view"}, control):
            assert 0 < person.post("/mqtt/credentials", purpose).json()["lifetime_s"] <= 45, purpose

    def test_a_key_that_runs_out_loses_its_live_sessions_and_its_control(
        self, cloud: Cloud, pair: Pair, broker: MemoryBroker
    ) -> None:
        anna, robot = pair
        _, program = make(anna, days=1)
        cloud.clock.advance(DAY_S - 600)
        anna = cloud.sign_in("anna")
        epoch = program.take(robot.device, lease_ms=600_000).json()["epoch"]
        control = {"purpose": "control", "device": robot.device, "epoch": epoch}
        lines = [self.connect(broker, program, purpose) for purpose in ({"purpose": "view"}, control)]
        hers = self.connect(broker, anna, {"purpose": "view"})
        cloud.clock.advance(600)
        began_s = time.monotonic()
        cloud.sweep()
        for line in lines:
            wait_until(line.disconnected.is_set, "the end of the connection")
        assert time.monotonic() - began_s < 10
        assert not hers.disconnected.is_set()
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
        for line in (*lines, hers):
            line.close()

    def connect(self, broker: MemoryBroker, person: Person, purpose: dict[str, Any]) -> Any:
        issued = person.post("/mqtt/credentials", purpose).json()
        line = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
        assert line.connected.is_set(), line.answer
        return line

    def test_an_action_that_a_key_has_begun_ends_with_the_key(self, cloud: Cloud, pair: Pair) -> None:
        anna, robot = pair
        _, program = make(anna, days=1)
        cloud.clock.advance(DAY_S - 60)
        anna = cloud.sign_in("anna")
        program.start(robot.device, timeout_ms=3_600_000, wait_ms=10_000)
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is not None
        cloud.clock.advance(60)
        cloud.sweep()
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
        wait_until(lambda: robot.heard(ReleaseLease), "the release")


@pytest.mark.parametrize("what", ["credentials", "control", "action"])
def test_what_a_key_asks_for_while_it_is_revoked_comes_to_nothing(
    cloud: Cloud, pair: Pair, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    anna, robot = pair
    key, program = make(anna)
    devices, tables = cloud.functions.devices, cloud.functions.tables
    name = "require_key" if what == "credentials" else "require_still_allowed"
    real = getattr(devices, name)

    async def meanwhile(*given: Any) -> Any:
        # All of a revocation but what looks for what is there to be ended: that was a moment ago.
        row = await tables.get(records.API_KEYS, key, "key")
        if row is not None:
            await tables.delete(records.API_KEYS, row)
        return await real(*given)

    monkeypatch.setattr(devices, name, meanwhile)
    if what == "credentials":
        answer = program.post("/mqtt/credentials", {"purpose": "view"})
    elif what == "control":
        answer = program.take(robot.device)
    else:
        answer = program.start(robot.device)
    assert "API key" in problem(answer, 403, "forbidden")["detail"]
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert robot.heard(MoveJoints) == []

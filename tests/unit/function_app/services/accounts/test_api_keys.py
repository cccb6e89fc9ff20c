"""API keys: made once, stored as a hash, kept to little, and gone when they are revoked."""

import re
from typing import Any

import pytest

from device_agent.protocol import ReleaseLease
from function_app.ports.broker_access import Credentials
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.fakes.clock import MovingClock
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, MOVE, Cloud, Person, paired, problem
from tests.harness.cloud.memory import Memory
from tests.harness.network.brokers import wait_until

KEYS = "/api-keys"
Pair = tuple[Person, Robot]


class Program(Person):
    """A third-party program with an API key."""

    def __init__(self, cloud: Cloud, token: str) -> None:
        self.cloud = cloud
        self.token = token
        self._client = cloud.client(headers={"Authorization": f"Bearer {token}"})

    def _stay(self) -> None:
        """A key is what it is."""


def make(person: Person, role: str = "operator", *only: str, **more: Any) -> tuple[str, Program]:
    """A new key's id, and a program that has it."""
    answer = person.post(KEYS, {"name": "Home Assistant", "role": role, "only": list(only), **more})
    assert answer.status_code == 201, answer.text
    body = answer.json()
    return body["api_key"]["id"], Program(person.cloud, body["token"])


@pytest.fixture
def operations(cloud: Cloud) -> dict[str, tuple[str, str, bool]]:
    """Every operation for accounts: method, path, and whether its description says that it takes API keys."""
    return {
        operation["operationId"]: (method.upper(), path, {"apiKey": []} in operation["security"])
        for path, methods in cloud.app.openapi()["paths"].items()
        for method, operation in methods.items()
        if {"accessToken": []} in operation["security"]
    }


def test_its_token_is_told_once_and_only_a_hash_is_stored(cloud: Cloud, memory: Memory) -> None:
    anna = cloud.sign_in("anna")
    answer = anna.post(KEYS, {"name": "Home Assistant", "role": "viewer"})
    token = answer.json()["token"]
    assert re.fullmatch(r"ts_[a-z2-7]{16}_[A-Za-z0-9_-]{43}", token)
    assert answer.headers["cache-control"] == "no-store"
    (listed,) = anna.get(KEYS).json()["items"]
    assert listed == answer.json()["api_key"]
    assert (listed["name"], listed["role"], listed["only"], listed["expired"]) == (
        "Home Assistant",
        "viewer",
        [],
        False,
    )
    secret = token.split("_", 2)[2]
    assert secret not in anna.get(KEYS).text
    stored = str(memory.tables.rows())
    assert "ApiKeys" in stored
    assert secret not in stored
    assert cloud.sign_in("bert").get(KEYS).json()["items"] == []


def test_who_it_is_says_which_program_it_is(pair: Pair) -> None:
    anna, robot = pair
    _, program = make(anna)
    me = program.get("/accounts/me").json()
    assert (me["id"], me["name"], me["csrf_token"]) == (anna.account, "anna (Home Assistant)", None)
    assert program.take(robot.device).json()["holder"] == "anna (Home Assistant)"
    assert problem(anna.take(robot.device), 409, "lease-held")["holder"] == "anna (Home Assistant)"


def test_a_key_may_do_what_its_description_says_and_nothing_else(
    pair: Pair, operations: dict[str, tuple[str, str, bool]]
) -> None:
    anna, robot = pair
    _, program = make(anna)
    ids = {"device": robot.device, "agent": robot.id, "space": robot.space, "robot_type": "ur5"}
    before = anna.get("/agents").text, anna.get("/spaces").text, anna.get(KEYS).json()["items"][0]["id"]
    refused = set()
    for name, (method, path, takes_keys) in operations.items():
        place = re.sub(r"{(\w+)(:path)?}", lambda found: ids.get(found[1], "x"), path).removeprefix(API)
        body = {"json": {"purpose": "view"}} if name == "xmpp_credentials" else {}
        answer = program.ask(method, place, **body)
        assert answer.status_code not in {401, 500}, f"{name}: {answer.text}"
        if not takes_keys:
            assert "API key" in problem(answer, 403, "forbidden")["detail"], name
            refused.add(name)
    assert {
        "create_api_key", "revoke_api_key", "list_api_keys", "put_password", "list_sessions", "end_other_sessions",
        "sign_out", "claim_agent", "unpair_agent", "move_agent", "create_space", "put_movement", "get_movement",
        "add_robot_type", "reset_stop", "begin_upload", "xmpp_credentials",
    } <= refused  # fmt: skip
    assert not {name for name in operations if "share" in name or "invit" in name or "transfer" in name} - refused
    assert (anna.get("/agents").text, anna.get("/spaces").text, anna.get(KEYS).json()["items"][0]["id"]) == before


def test_every_operation_that_takes_keys_is_there(operations: dict[str, tuple[str, str, bool]]) -> None:
    from function_app.entrypoints.http.framework.api_key_scopes import FOR_KEYS

    assert {name for name, (_, _, takes_keys) in operations.items() if takes_keys} == FOR_KEYS


def test_a_viewers_key_moves_and_stops_nothing(pair: Pair) -> None:
    anna, robot = pair
    _, program = make(anna, "viewer")
    assert program.get(f"/devices/{robot.device}").json()["role"] == "viewer"
    for path, body in (("lease", {}), ("actions", {"request": MOVE}), ("stop", {})):
        problem(program.post(f"/devices/{robot.device}/{path}", body), 403, "forbidden")
    issued = program.post("/mqtt/credentials", {"purpose": "view"}).json()
    assert issued["publish"] == []
    assert issued["subscribe"]


def test_an_operators_key_cannot_take_over_control(pair: Pair) -> None:
    anna, robot = pair
    _, program = make(anna)
    anna.take(robot.device)
    problem(program.take(robot.device, take_over=True, reason="x"), 403, "forbidden")


def test_a_key_is_kept_to_its_devices(cloud: Cloud) -> None:
    with paired(cloud, "anna", "arm", "leg") as (anna, robot):
        arm, leg = robot.devices
        _, program = make(anna, "operator", arm)
        assert [each["id"] for each in program.get("/devices").json()["items"]] == [arm]
        problem(program.get(f"/devices/{leg}"), 404, "device-unknown")
        problem(program.take(leg), 404, "device-unknown")
        issued = program.post("/mqtt/credentials", {"purpose": "view"}).json()
        assert not [topic for topic in (*issued["subscribe"], *issued["publish"]) if "/leg/" in topic]
        _, whole = make(anna, "operator", f"space:{robot.space}")
        assert len(whole.get("/devices").json()["items"]) == 2
        for missing in ("space:nowhere", "zzzzzzzzzz-arm", "x"):
            assert anna.post(KEYS, {"name": "x", "role": "viewer", "only": [missing]}).status_code == 404
        bert = cloud.sign_in("bert")
        for foreign in (arm, f"space:{robot.space}"):
            assert bert.post(KEYS, {"name": "x", "role": "viewer", "only": [foreign]}).status_code == 404


def test_what_is_no_key_is_not_made(cloud: Cloud) -> None:
    anna = cloud.sign_in("anna")
    for wrong in ({"role": "owner"}, {"days": 0}, {"days": 367}, {"name": ""}, {"only": ["a b"]}, {"more": 1}):
        problem(anna.post(KEYS, {"name": "x", "role": "viewer", **wrong}), 422, "invalid")


def test_wrong_unknown_and_mixed_up_tokens_are_answered_the_same(cloud: Cloud) -> None:
    anna = cloud.sign_in("anna")
    (_, one), (_, two) = make(anna), make(anna)
    key, _, secret = two.token.removeprefix("ts_").partition("_")
    told = set()
    for token in (
        "ts_", "ts_x_y", f"ts_{key}_", f"ts_{key}_{one.token[-43:]}", f"ts_{key}_{secret[:-1]}",
        f"ts_{'a' * 16}_{secret}", f"TS_{key}_{secret}", f"ts_{key}_{secret}\n",
    ):  # fmt: skip
        answer = cloud.ask("GET", f"{API}/devices", headers={b"Authorization": f"Bearer {token}".encode()})
        if token.startswith("ts_") and not token.endswith("\n"):
            told.add(problem(answer, 401, "unauthorized")["detail"])
    assert len(told) == 1
    client = cloud.client(cookies={"telescope_session": two.token})
    problem(cloud.run(client.get(f"{API}/accounts/me")), 401, "unauthorized")
    assert two.get("/devices").status_code == 200


def test_it_ends_when_its_time_is_over_and_is_forgotten_a_month_later(alone_clock: tuple[Cloud, MovingClock]) -> None:
    cloud, clock = alone_clock
    _, program = make(cloud.sign_in("anna"), days=1)
    assert program.get("/devices").status_code == 200
    clock.advance(24 * 3600)
    problem(program.get("/devices"), 401, "unauthorized")
    assert [each["expired"] for each in cloud.sign_in("anna").get(KEYS).json()["items"]] == [True]
    clock.advance(31 * 24 * 3600)
    cloud.sweep()
    assert cloud.sign_in("anna").get(KEYS).json()["items"] == []


@pytest.fixture
def alone_clock(open_cloud: OpenCloud) -> tuple[Cloud, MovingClock]:
    clock = MovingClock()
    return open_cloud(clock=clock), clock


def test_its_use_is_noted_once_an_hour(alone_clock: tuple[Cloud, MovingClock]) -> None:
    cloud, clock = alone_clock
    anna = cloud.sign_in("anna")
    key, program = make(anna)

    def version() -> str:
        row = cloud.run(cloud.functions.tables.get(records.API_KEYS, key, "key"))
        assert row is not None
        return row.etag

    assert anna.get(KEYS).json()["items"][0]["last_used_at"] is None
    program.get("/devices")
    assert anna.get(KEYS).json()["items"][0]["last_used_at"] is not None
    first = version()
    for _ in range(3):
        clock.advance(10)
        program.get("/devices")
    assert version() == first
    clock.advance(3600)
    program.get("/devices")
    assert version() != first


class TestRevoking:
    def test_it_is_refused_here_at_once_and_elsewhere_within_seconds(self, open_cloud: OpenCloud) -> None:
        clock = MovingClock()
        here, there = open_cloud(clock=clock), open_cloud(clock=clock)
        anna = here.sign_in("anna")
        key, program = make(anna)
        elsewhere = Program(there, program.token)
        assert program.get("/devices").status_code == elsewhere.get("/devices").status_code == 200
        problem(here.sign_in("bert").delete(f"{KEYS}/{key}"), 404, "api-key-unknown")
        assert anna.delete(f"{KEYS}/{key}").status_code == 204
        problem(program.get("/devices"), 401, "unauthorized")
        clock.advance(5)
        problem(elsewhere.get("/devices"), 401, "unauthorized")
        problem(anna.delete(f"{KEYS}/{key}"), 404, "api-key-unknown")
        assert anna.get(KEYS).json()["items"] == []

    def test_only_its_own_connections_and_control_end(self, pair: Pair, broker: MemoryBroker) -> None:
        anna, robot = pair
        (key, program), (_, other) = make(anna), make(anna)
        epoch = program.take(robot.device, lease_ms=600_000, wait_ms=10_000).json()["epoch"]
        control = {"purpose": "control", "device": robot.device, "epoch": epoch}
        given = [
            program.post("/mqtt/credentials", {"purpose": "view"}).json(),
            program.post("/mqtt/credentials", control).json(),
            other.post("/mqtt/credentials", {"purpose": "view"}).json(),
        ]
        lines = [broker.connect(each["client_id"], Credentials(each["username"], each["password"])) for each in given]
        assert all(line.connected.is_set() for line in lines)
        assert anna.delete(f"{KEYS}/{key}").status_code == 204
        for line in lines[:2]:
            wait_until(line.disconnected.is_set, "the end of the connection")
        assert not lines[2].disconnected.is_set()
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
        wait_until(lambda: robot.heard(ReleaseLease), "the release at the robot")
        for line in lines:
            line.close()


def test_an_account_has_at_most_fifty(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("function_app.services.accounts.api_keys.MOST", 2)
    anna = cloud.sign_in("anna")
    for _ in range(2):
        make(anna)
    problem(anna.post(KEYS, {"name": "x", "role": "viewer"}), 409, "too-many-keys")


def test_one_that_is_used_while_it_is_revoked_is_revoked(
    cloud: Cloud, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    anna, _ = pair
    key, program = make(anna)
    tables: Any = cloud.functions.tables
    delete = tables.delete
    used: list[Any] = []

    async def between(table: str, row: Any) -> None:
        if table == records.API_KEYS and not used:
            client = cloud.client(headers={"Authorization": f"Bearer {program.token}"})
            used.append(await client.get(f"{API}/devices"))
        await delete(table, row)

    monkeypatch.setattr(tables, "delete", between)
    assert anna.delete(f"{KEYS}/{key}").status_code == 204
    assert used[0].status_code == 200
    problem(program.get("/devices"), 401, "unauthorized")

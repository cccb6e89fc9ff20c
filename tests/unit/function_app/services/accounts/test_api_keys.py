"""API keys are stored as hashes, limited, and invalid after their revocation."""

import re
from typing import Any

import pytest

from device_agent.protocol import ReleaseLease
from function_app.entrypoints.http.framework.api_key_scopes import FOR_KEYS
from function_app.ports.broker_access import Credentials
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, Cloud, Person, paired, problem
from tests.harness.cloud.memory import Memory

KEYS = "/api-keys"


class Program(Person):
    """A third-party program with an API key."""

    def __init__(self, cloud: Cloud, token: str) -> None:
        self.cloud = cloud
        self.token = token
        self._client = cloud.client(headers={"Authorization": f"Bearer {token}"})

    def _renew_token(self) -> None:
        """An API key is not renewed."""


def make(person: Person, role: str = "operator", *only: str, **more: Any) -> tuple[str, Program]:
    """Create a key; return its id and a program that uses it."""
    answer = person.post(KEYS, {"name": "Home Assistant", "role": role, "only": list(only), **more})
    assert answer.status_code == 201, answer.text
    body = answer.json()
    return body["api_key"]["id"], Program(person.cloud, body["token"])


def test_the_token_is_shown_once_and_only_its_hash_is_stored(cloud: Cloud, memory: Memory) -> None:
    anna = cloud.sign_in("anna")
    answer = anna.post(KEYS, {"name": "Home Assistant", "role": "viewer"})
    token = answer.json()["token"]
    assert re.fullmatch(r"ts_[a-z2-7]{16}_[A-Za-z0-9_-]{43}", token)
    assert answer.headers["cache-control"] == "no-store"
    (listed,) = anna.get(KEYS).json()["items"]
    assert listed == answer.json()["api_key"]
    assert listed.items() >= {"name": "Home Assistant", "role": "viewer", "only": [], "expired": False}.items()
    secret = token.split("_", 2)[2]
    assert secret not in anna.get(KEYS).text
    stored = str(memory.tables.rows())
    assert "ApiKeys" in stored
    assert secret not in stored
    assert cloud.sign_in("bert").get(KEYS).json()["items"] == []


def test_documented_operations_are_those_that_keys_may_call(cloud: Cloud) -> None:
    """Which responses they get is in tests/security/tenants."""
    methods = [method for methods in cloud.app.openapi()["paths"].values() for method in methods.values()]
    assert {each["operationId"] for each in methods if {"apiKey": []} in each["security"]} == FOR_KEYS


def test_an_operators_key_has_its_own_name_and_cannot_take_over(anna: Person, robot: Robot) -> None:
    _, program = make(anna)
    me = program.get("/accounts/me").json()
    assert (me["id"], me["name"], me["csrf_token"]) == (anna.account, "anna (Home Assistant)", None)
    assert program.take_lease(robot.device).json()["holder"] == "anna (Home Assistant)"
    assert problem(anna.take_lease(robot.device), 409, "lease-held")["holder"] == "anna (Home Assistant)"
    anna.take_lease(robot.device, take_over=True, reason="x")
    problem(program.take_lease(robot.device, take_over=True, reason="x"), 403, "forbidden")
    assert "API key" in problem(program.get(KEYS), 403, "forbidden")["detail"]


def test_a_key_is_limited_to_its_devices(cloud: Cloud) -> None:
    with paired(cloud, "anna", "arm", "leg") as (anna, robot):
        arm, leg = robot.devices
        _, program = make(anna, "operator", arm)
        assert [each["id"] for each in program.get("/devices").json()["items"]] == [arm]
        problem(program.get(f"/devices/{leg}"), 404, "device-unknown")
        problem(program.take_lease(leg), 404, "device-unknown")
        issued = program.post("/mqtt/credentials", {"purpose": "view"}).json()
        assert not [topic for topic in (*issued["subscribe"], *issued["publish"]) if "/leg/" in topic]
        _, whole = make(anna, "viewer", f"space:{robot.space}")
        assert len(whole.get("/devices").json()["items"]) == 2
        assert whole.post("/mqtt/credentials", {"purpose": "view"}).json()["publish"] == [], "a viewer cannot stop"
        for missing in ("space:nowhere", "zzzzzzzzzz-arm", "x"):
            assert anna.post(KEYS, {"name": "x", "role": "viewer", "only": [missing]}).status_code == 404
        bert = cloud.sign_in("bert")
        for foreign in (arm, f"space:{robot.space}"):
            assert bert.post(KEYS, {"name": "x", "role": "viewer", "only": [foreign]}).status_code == 404


def test_invalid_keys_are_refused(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    anna = cloud.sign_in("anna")
    for wrong in ({"role": "owner"}, {"days": 0}, {"days": 367}, {"name": ""}, {"only": ["a b"]}, {"more": 1}):
        problem(anna.post(KEYS, {"name": "x", "role": "viewer", **wrong}), 422, "invalid")
    monkeypatch.setattr("function_app.services.accounts.api_keys.MAX_KEYS", 2)
    for _ in range(2):
        make(anna)
    problem(anna.post(KEYS, {"name": "x", "role": "viewer"}), 409, "too-many-keys")


def test_wrong_and_unknown_tokens_are_indistinguishable(cloud: Cloud) -> None:
    anna = cloud.sign_in("anna")
    (_, one), (_, two) = make(anna), make(anna)
    key, _, secret = two.token.removeprefix("ts_").partition("_")
    details = set()
    for token in (
        "ts_", "ts_x_y", f"ts_{key}_", f"ts_{key}_{one.token[-43:]}", f"ts_{key}_{secret[:-1]}",
        f"ts_{'a' * 16}_{secret}", f"TS_{key}_{secret}", f"ts_{key}_{secret}\n",
    ):  # fmt: skip
        answer = cloud.request("GET", f"{API}/devices", headers={b"Authorization": f"Bearer {token}".encode()})
        if token.startswith("ts_") and not token.endswith("\n"):
            details.add(problem(answer, 401, "unauthorized")["detail"])
    assert len(details) == 1
    client = cloud.client(cookies={"telescope_session": two.token})
    problem(cloud.run(client.get(f"{API}/accounts/me")), 401, "unauthorized")
    assert two.get("/devices").status_code == 200


def test_a_key_expires_and_is_deleted_a_month_later(cloud: Cloud) -> None:
    _, program = make(cloud.sign_in("anna"), days=1)
    assert program.get("/devices").status_code == 200
    cloud.clock.advance(24 * 3600)
    problem(program.get("/devices"), 401, "unauthorized")
    assert [each["expired"] for each in cloud.sign_in("anna").get(KEYS).json()["items"]] == [True]
    cloud.clock.advance(31 * 24 * 3600)
    cloud.sweep()
    assert cloud.sign_in("anna").get(KEYS).json()["items"] == []


def test_the_last_use_is_stored_once_an_hour(cloud: Cloud) -> None:
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
        cloud.clock.advance(10)
        program.get("/devices")
    assert version() == first
    cloud.clock.advance(3600)
    program.get("/devices")
    assert version() != first


class TestRevoking:
    def test_it_is_refused_locally_at_once_and_in_other_processes_within_seconds(self, open_cloud: OpenCloud) -> None:
        local, remote = open_cloud(), open_cloud()
        anna = local.sign_in("anna")
        key, program = make(anna)
        elsewhere = Program(remote, program.token)
        assert program.get("/devices").status_code == elsewhere.get("/devices").status_code == 200
        problem(local.sign_in("bert").delete(f"{KEYS}/{key}"), 404, "api-key-unknown")
        assert anna.delete(f"{KEYS}/{key}").status_code == 204
        problem(program.get("/devices"), 401, "unauthorized")
        local.clock.advance(5)
        problem(elsewhere.get("/devices"), 401, "unauthorized")
        problem(anna.delete(f"{KEYS}/{key}"), 404, "api-key-unknown")
        assert anna.get(KEYS).json()["items"] == []

    def test_only_its_own_connections_and_control_end(self, anna: Person, robot: Robot, broker: MemoryBroker) -> None:
        (key, program), (_, other) = make(anna), make(anna)
        epoch = program.take_lease(robot.device, lease_ms=600_000, wait_ms=10_000).json()["epoch"]
        control = {"purpose": "control", "device": robot.device, "epoch": epoch}
        clients = []
        for caller, body in ((program, {"purpose": "view"}), (program, control), (other, {"purpose": "view"})):
            issued = caller.post("/mqtt/credentials", body).json()
            credentials = Credentials(issued["username"], issued["password"])
            clients.append(broker.connect(issued["client_id"], credentials))
        assert [client.is_open for client in clients] == [True, True, True]
        assert anna.delete(f"{KEYS}/{key}").status_code == 204
        assert [client.is_open for client in clients] == [False, False, True]
        assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
        assert robot.received(ReleaseLease)


def test_a_key_in_use_is_revoked(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    anna = cloud.sign_in("anna")
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

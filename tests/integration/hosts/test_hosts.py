"""The functions under each host: requests, the timer, and messages of devices."""

import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from device_agent.protocol import AckStatus, MoveJoints, Presence, codec, topics
from function_app.entrypoints.http.framework.authentication import CSRF_HEADER
from function_app.entrypoints.http.framework.responses import MAX_BODY
from tests.harness.cloud.cloud import API, MOVE, problem
from tests.harness.cloud.polling import PollingRobot
from tests.harness.hosts import HOSTS, HostFailed, HostKind, start_host
from tests.harness.hosts.host import PATIENCE_S
from tests.harness.hosts.host_client import HostClient
from tests.harness.network.brokers import wait_until


@pytest.fixture(scope="module", params=HOSTS)
def kind(request: pytest.FixtureRequest) -> HostKind:
    found: HostKind = request.param
    return found


@pytest.fixture(scope="module")
def client(kind: HostKind, tmp_path_factory: pytest.TempPathFactory) -> Iterator[HostClient]:
    home = tmp_path_factory.mktemp(kind)
    environment = {"TELESCOPE_HOME": str(home), "TELESCOPE_MQTT_PORT": "1"}
    with start_host(kind, environment) as host:
        yield HostClient(host, environment)


def test_a_person_signs_in_with_a_cookie_and_out_again(client: HostClient) -> None:
    with httpx.Client(base_url=client.host.url + API, timeout=PATIENCE_S) as anna:
        answer = anna.post("/auth/sign-in", json={"link": client.link("anna")})
        (cookie,) = answer.headers.get_list("set-cookie")
        fields = {part.strip().lower().partition("=")[0] for part in cookie.split(";")}
        assert fields >= {"path", "max-age", "httponly", "samesite"}
        assert anna.get("/accounts/me").json()["name"] == "anna"
        signed_out = anna.post("/auth/sign-out", headers={CSRF_HEADER: answer.json()["csrf_token"]})
        assert (signed_out.status_code, signed_out.content) == (204, b"")
        assert list(anna.cookies.jar) == []
        problem(anna.get("/accounts/me"), 401, "unauthorized")


def test_bodies_are_transferred_completely(client: HostClient) -> None:
    document = client.request("GET", f"{API}/openapi.json")
    assert len(document.content) == int(document.headers["content-length"]) > 50_000
    assert document.json()["openapi"].startswith("3.")
    sign_in = f"{API}/auth/sign-in"
    problem(client.request("POST", sign_in, content=b" " * (MAX_BODY + 1)), 413, "too-large")
    problem(client.request("POST", sign_in, content=b" " * MAX_BODY), 422, "invalid")
    problem(client.request("POST", sign_in, content=b"\x00\xff\xfe"), 422, "invalid")
    problem(client.request("POST", sign_in, content='{"link": "grüß 🤖"}'.encode()), 401, "unauthorized")
    assert client.request("HEAD", f"{API}/health").content == b""


def test_invalid_paths_and_queries_are_problems(client: HostClient) -> None:
    with client.sign_in("anna") as anna:
        for path in ("%ff", "a%2Fb", "a+b%20c", "gr%C3%BC%C3%9F", "%25", "a;b=c"):
            answer = anna.get(f"/devices/{path}")
            assert answer.status_code in {404, 422}, answer.text
            assert answer.headers["content-type"] == "application/problem+json"
        problem(anna.get("/devices?cursor=%F0%9F%A4%96%20%26%3D%2B"), 422, "cursor-invalid")
        problem(anna.get("/devices?limit=5&limit=x"), 422, "invalid")
        problem(anna.get("/devices?cursor=%ff"), 422, "cursor-invalid")
        for query in ("limit=5&cursor=", "limit=1&limit=2"):
            assert anna.get(f"/devices?{query}").status_code in {200, 422}
        problem(anna.get("/nothing"), 404, "http")
        problem(anna.post("/devices"), 405, "http")
    assert int(client.request("GET", f"{API}/health").headers["x-telescope-time-ms"]) > 0


def test_messages_of_devices_are_stored_and_the_timer_checks_actions(client: HostClient) -> None:
    with client.sign_in("bert") as bert, client.robot() as robot:
        client.pair(bert, robot)
        assert bert.get(f"/devices/{robot.device}").json()["online"] is False
        presence = Presence(online=True, session=1, at_ms=client.clock.now_ms())
        client.host.deliver(topics.conn(robot.space, robot.id), codec.encode(presence))
        assert bert.get(f"/devices/{robot.device}").json()["online"] is True
        client.host.deliver(topics.conn(robot.space, robot.id), b"nonsense")
        client.host.deliver("nonsense", b"")

        response = bert.post(f"/devices/{robot.device}/actions", json={"request": MOVE, "ttl_ms": 1_000})
        action = f"/actions/{response.json()['id']}"

        def unknown() -> bool:
            client.host.tick()
            return bool(bert.get(action).json()["status"] == "unknown")

        wait_until(unknown, "the timer to check the action", PATIENCE_S)


def test_an_error_reaches_the_host_which_delivers_again(kind: HostKind, tmp_path: Path) -> None:
    with start_host(kind, {"TELESCOPE_HOME": str(tmp_path)}) as host:
        for file in tmp_path.glob("tables.sqlite*"):
            file.unlink()
        (tmp_path / "tables.sqlite").write_bytes(b"no database " * 1000)
        with pytest.raises(HostFailed, match="damaged"):
            host.tick()
        with pytest.raises(HostFailed, match="damaged"):
            host.deliver("ts/v1/space/agent/conn", json.dumps({"online": True, "session": 1, "at_ms": 1}).encode())
        problem(httpx.post(f"{host.url}{API}/auth/sign-in", json={"link": "x"}), 503, "store-unavailable")


def test_a_polling_robot_executes_actions(client: HostClient) -> None:
    """A polling robot uses HTTP only."""
    with client.sign_in("anna") as anna, PollingRobot(client, wait_ms=0, pause_s=0.1) as robot:
        client.pair(anna, robot)
        robot.connect()
        assert anna.get(f"/devices/{robot.device}").json()["online"]
        body = {"request": MOVE, "wait_ms": 0}
        action = anna.post(f"/devices/{robot.device}/actions", json=body).json()["id"]
        wait_until(lambda: anna.get(f"/actions/{action}").json()["status"] == "started", "the action to start")
        robot.report(action, AckStatus.DONE)
        assert anna.get(f"/actions/{action}").json()["status"] == "done"
        assert len(robot.payloads[action]) >= 1
        assert [command.id for command in robot.received(MoveJoints)] == [action]

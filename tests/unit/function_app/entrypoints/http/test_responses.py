"""Responses of the API: problem details, security headers, and no 500 for invalid requests."""

import asyncio
import contextlib
import logging
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.routing import APIRoute
from starlette.routing import Match
from starlette.types import Scope

from device_agent.protocol.security.log_output import TextFormatter
from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.framework.responses import MAX_BODY
from function_app.entrypoints.http.framework.responses import problem as problem_response
from function_app.settings import Administration, Xmpp
from tests.fakes.clock import MovingClock
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, Cloud, Person, problem
from tests.harness.cloud.cloud import settings as cloud_settings

SIGN_IN = f"{API}/auth/sign-in"
DEVICE = "abcdefgh23-arm"
OPTIONAL_BODY = (f"/devices/{DEVICE}/lease", f"/devices/{DEVICE}/stop")
WITHOUT_FIELDS = [
    f"/devices/{DEVICE}/stop/reset",
    f"/devices/{DEVICE}/lease/requests/r/reject",
    "/actions/a/cancel",
    "/auth/sign-out",
]
WITH_BODY = ["/auth/sign-in", "/agents/enroll", "/agents/claim", "/mqtt/credentials", f"/devices/{DEVICE}/actions"]
BODIES = {
    "empty": b"",
    "space": b" ",
    "text": b"hello",
    "half": b'{"link": ',
    "twice": b"{}{}",
    "utf-16": '{"link":"x"}'.encode("utf-16"),
    "latin-1": '{"link":"ü"}'.encode("latin-1"),
    "surrogate": b'{"link":"\\ud800"}',
    "nan": b'{"link":NaN,"lease_ms":NaN,"code":NaN,"source":NaN,"request":NaN}',
    "infinite": b'{"lease_ms":1e999,"epoch":1e999,"wait_ms":-1e999,"reason":1e999,"purpose":1e999}',
    "nested lists": b"[" * 200_000,
    "nested objects": b'{"request":' * 50_000,
    "deep parameters": b'{"request":{"kind":"run_movement","name":"wave","parameters":' + b'{"a":' * 700 + b"1",
    "list": b"[]",
    "null": b"null",
    "number": b"1",
    "text value": b'"x"',
    "wrong types": b'{"link":1,"code":[],"lease_ms":"1000","epoch":true,"reason":{},"source":null,"request":[]}',
    "unknown field": b'{"link":"x","code":"x","lease_ms":1000,"surprise":1}',
    "huge integer": b'{"lease_ms":' + b"9" * 5000 + b',"epoch":' + b"9" * 5000 + b"}",
    "fraction": b'{"lease_ms":1000.5,"epoch":1.5,"wait_ms":0.1}',
    "negative": b'{"lease_ms":-1,"epoch":-1,"wait_ms":-1}',
}


@pytest.fixture(scope="module")
def anna(cloud: Cloud) -> Person:
    return cloud.sign_in("anna")


@pytest.mark.parametrize("path", [*WITH_BODY, *OPTIONAL_BODY, "/robot-types/ur5/movements/mine"])
@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES.keys())
def test_an_invalid_body_is_rejected_with_a_problem(anna: Person, path: str, body: bytes) -> None:
    response = anna.request("PUT" if "/robot-types/" in path else "POST", path, content=body)
    if path in OPTIONAL_BODY and body == b"":
        problem(response, 404, "device-unknown")
    else:
        problem(response, 422, "invalid")


@pytest.mark.parametrize("path", WITHOUT_FIELDS)
def test_a_body_without_fields_may_be_empty_but_contains_nothing_else(anna: Person, path: str) -> None:
    for body in (b'{"epoch": 1}', b"null", b"[]", b"text", b"[" * 200_000):
        assert "body" in problem(anna.request("POST", path, content=body), 422, "invalid")["detail"]
    if path != "/auth/sign-out":
        for body in (b"", b"{}"):
            assert anna.request("POST", path, content=body).status_code == 404


class TestBodySize:
    def test_a_body_of_maximum_size_is_accepted(self, cloud: Cloud) -> None:
        body = b'{"link":"x"}'
        problem(cloud.request("POST", SIGN_IN, content=body.ljust(MAX_BODY)), 401, "unauthorized")

    @pytest.mark.parametrize("length", ["1" * 5000, "-5", "x", "", "٣", "1, 2"])
    def test_an_invalid_content_length_causes_no_server_error(self, cloud: Cloud, length: str) -> None:
        headers = {"content-length": length.encode()}
        response = cloud.request("POST", SIGN_IN, content=b'{"link":"x"}', headers=headers)
        assert response.status_code in {401, 413, 422}

    def test_a_client_that_disconnects_during_the_body_causes_no_server_error(self, cloud: Cloud) -> None:
        sent: list[Any] = []

        async def disconnect() -> None:
            messages: list[dict[str, Any]] = [
                {"type": "http.request", "body": b'{"li', "more_body": True},
                {"type": "http.disconnect"},
            ]

            async def receive() -> dict[str, Any]:
                return messages.pop(0)

            async def send(message: Any) -> None:
                sent.append(message)

            scope = {"type": "http", "method": "POST", "path": SIGN_IN, "headers": [], "query_string": b""}
            await cloud.app(scope, receive, send)

        cloud.run(disconnect())
        assert not sent or sent[0]["status"] < 500


class TestErrors:
    @pytest.mark.parametrize(
        "path", ["/api", "/api/", "/api/v1", "/api/v1/nothing", "/api/v2/health", "/api/v1/health/"]
    )
    def test_an_unknown_path_is_a_problem(self, cloud: Cloud, path: str) -> None:
        for method in ("GET", "POST", "DELETE"):
            problem(cloud.request(method, path), 404, "http")

    @pytest.mark.parametrize(
        ("method", "path", "allowed"),
        [
            ("POST", "/health", {"GET"}),
            ("GET", "/auth/sign-in", {"POST"}),
            ("DELETE", "/devices", {"GET"}),
            ("PATCH", "/accounts/me", {"GET"}),
            ("PUT", f"/devices/{DEVICE}/lease", {"GET", "POST", "DELETE"}),
        ],
    )
    def test_an_unsupported_method_is_405_with_the_supported_ones(
        self, cloud: Cloud, method: str, path: str, allowed: set[str]
    ) -> None:
        response = cloud.request(method, API + path)
        problem(response, 405, "http")
        assert set(response.headers["allow"].split(", ")) == allowed

    def test_an_unhandled_error_is_a_problem_without_details(
        self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        async def broken() -> None:
            raise RuntimeError("a secret")

        monkeypatch.setattr(cloud.functions.health, "check", broken, raising=True)
        response = cloud.request("GET", f"{API}/health")
        problem(response, 500, "internal")
        assert "secret" not in response.text
        assert response.headers["x-content-type-options"] == "nosniff"

    def test_unavailable_tables_are_503_and_reported_by_the_health_check(self, tmp_path: Path) -> None:
        administration = Administration(metrics_token="a-token-of-the-monitoring")
        with Cloud(cloud_settings(tmp_path, administration=administration)) as cloud:
            anna = cloud.sign_in("anna")
            cloud.run(cloud.functions.tables.close())
            (tmp_path / "tables.sqlite").write_bytes(b"no database " * 100)
            for name in ("tables.sqlite-wal", "tables.sqlite-shm"):
                (tmp_path / name).unlink(missing_ok=True)
            response = anna.get("/devices")
            problem(response, 503, "store-unavailable")
            assert response.headers["retry-after"]
            assert str(tmp_path) not in response.text
            for headers, shown in (({}, False), ({"Authorization": "Bearer a-token-of-the-monitoring"}, True)):
                answer = cloud.request("GET", f"{API}/health", headers=headers)
                assert ("damaged" in problem(answer, 503, "store-unavailable")["detail"]) is shown

    def test_a_problem_has_its_extra_members_and_retry_after(self) -> None:
        response = problem_response(Problem("x", 429, "T", "D.", retry_after_s=7, extras={"holder": "anna"}))
        assert response.headers["retry-after"] == "7"
        assert bytes(response.body) == b'{"type":"/problems/x","title":"T","status":429,"detail":"D.","holder":"anna"}'


class TestHeaders:
    @pytest.mark.parametrize(
        "path", ["/", "/assets/app-0123abcd.js", "/api/docs", "/api/v1/health", "/api/v1/devices", "/api/v1/nothing"]
    )
    def test_every_response_has_security_headers(self, cloud: Cloud, path: str) -> None:
        headers = cloud.request("GET", path).headers
        policy = dict(part.strip().split(" ", 1) for part in headers["content-security-policy"].split(";"))
        assert policy == {
            **dict.fromkeys(("default-src", "base-uri", "form-action", "frame-ancestors"), "'none'"),
            **dict.fromkeys(("script-src", "style-src", "font-src"), "'self'"),
            "img-src": "'self' data: blob:",
            "connect-src": "'self' ws://127.0.0.1:8082/mqtt",
        }
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["x-frame-options"] == "DENY"
        assert headers["cross-origin-opener-policy"] == "same-origin"

    def test_the_policy_names_the_xmpp_server_for_browsers_and_nothing_else(self, open_cloud: OpenCloud) -> None:
        cloud = open_cloud(xmpp=Xmpp(domain="example.org", websocket_url="wss://xmpp.example.org/xmpp-websocket"))
        policy = cloud.request("GET", "/api/v1/nothing").headers["content-security-policy"]
        servers = "ws://127.0.0.1:8082/mqtt wss://xmpp.example.org/xmpp-websocket"
        assert f"; connect-src 'self' {servers}; base-uri" in policy

    @pytest.mark.parametrize(
        ("received", "kept"), [("a-1.b:2_C", True), ("", False), ("with space", False), ("x" * 65, False)]
    )
    def test_every_response_has_the_request_id_of_the_client_or_a_new_one(
        self, cloud: Cloud, caplog: pytest.LogCaptureFixture, received: str, kept: bool
    ) -> None:
        headers = [cloud.request("GET", "/api/v1/nothing", headers={"X-Request-Id": received}).headers for _ in "12"]
        ids = [each["x-request-id"] for each in headers]
        assert (ids == [received] * 2) is kept
        assert (len(set(ids)) == 2) is not kept
        assert not caplog.records

    def test_log_lines_of_a_request_name_it_and_its_device(self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
        lines = []

        async def broken(*_: object) -> None:
            lines.append(TextFormatter().format(logging.LogRecord("x", 30, "", 1, "broken", (), None)))
            raise RuntimeError

        monkeypatch.setattr(cloud.functions.devices, "view", broken)
        anna = cloud.sign_in("anna")
        anna.get("/devices/a-arm", headers={"X-Request-Id": "r7"})
        assert lines[0].endswith("broken [request=r7 device=a-arm]")

    def test_every_response_has_the_server_time(self, tmp_path: Path) -> None:
        clock = MovingClock()
        with Cloud(cloud_settings(tmp_path), clock=clock) as cloud:
            clock.advance(1_000_000)
            for path in ("/api/v1/health", "/api/v1/devices", "/nothing"):
                server_ms = int(cloud.request("GET", path).headers["x-telescope-time-ms"])
                assert abs(clock.now_ms() - server_ms) < 20_000

    def test_other_origins_are_rejected(self, cloud: Cloud) -> None:
        response = cloud.request("OPTIONS", f"{API}/devices", headers={"Origin": "https://evil.example"})
        assert response.status_code == 405
        assert not [name for name in response.headers if name.startswith("access-control-")]


class TestConsole:
    def test_pages_are_revalidated_and_assets_are_cached(self, cloud: Cloud) -> None:
        page = cloud.request("GET", "/")
        assert (page.status_code, page.headers["cache-control"]) == (200, "no-cache")
        unchanged = cloud.request("GET", "/", headers={"If-None-Match": page.headers["etag"]})
        assert unchanged.status_code == 304
        asset = cloud.request("GET", "/assets/app-0123abcd.js")
        assert asset.headers["cache-control"] == "public, max-age=31536000, immutable"
        assert cloud.request("HEAD", "/").status_code == 200
        problem(cloud.request("POST", "/"), 405, "http")

    def test_the_default_icon_path_returns_the_icon(self, cloud: Cloud) -> None:
        icon = cloud.request("GET", "/favicon.ico")
        assert (icon.status_code, icon.headers["content-type"]) == (200, "image/svg+xml")
        assert icon.headers["cache-control"] == "no-cache", "the path stays the same when the icon changes"

    @pytest.mark.parametrize(
        "path",
        [
            "/../tables.sqlite",
            "/%2e%2e/tables.sqlite",
            "/..%2ftables.sqlite",
            "/assets/../../tables.sqlite",
            "/%00",
            "/assets",
        ],
    )
    def test_files_outside_its_folder_are_not_served(self, cloud: Cloud, path: str) -> None:
        response = cloud.run(cloud.client().send(httpx.Request("GET", f"http://x{path}")))
        problem(response, 404, "http")

    def test_a_missing_console_is_404_with_a_hint(self, tmp_path: Path) -> None:
        with Cloud(cloud_settings(tmp_path, console=tmp_path / "missing")) as cloud:
            assert "make console" in problem(cloud.request("GET", "/"), 404, "http")["detail"]

    def test_a_websocket_is_closed_without_an_error(self, cloud: Cloud) -> None:
        sent: list[Any] = []

        async def connect() -> None:
            async def receive() -> dict[str, Any]:
                return {"type": "websocket.connect"}

            async def send(message: Any) -> None:
                sent.append(message)

            scope = {"type": "websocket", "path": "/mqtt", "headers": [], "query_string": b"", "root_path": ""}
            with contextlib.suppress(asyncio.CancelledError):
                await cloud.app(scope, receive, send)

        cloud.run(connect())
        assert [message["type"] for message in sent] == ["websocket.close"]


class TestRouteIndex:
    def test_it_finds_the_same_routes_as_a_linear_search(self, cloud: Cloud) -> None:
        index = cloud.app.state.route_index
        paths = {route.path_format.replace("{", "x").replace("}", "") for route in index.routes}
        paths |= {f"{path}/more" for path in paths} | {f"{path}/" for path in paths}
        paths |= {"", "/", "//", f"{API}/devicesx", f"{API}/devices//lease", f"{API}/robot-types/ur5/files/a/b.obj"}
        for path in paths:
            expected = [route.path for route in index.routes if route.path_regex.match(path)]
            assert [route.path for route in index.on_path({"path": path})] == expected, path

    def test_it_finds_routes_behind_a_path_prefix_of_the_host(self, cloud: Cloud) -> None:
        scope = {"type": "http", "method": "GET", "path": f"/stage{API}/devices/{DEVICE}", "root_path": "/stage"}
        match, found = cloud.app.state.route_index.matches(scope)
        assert (match, found["route"].path) == (Match.FULL, f"{API}/devices/{{device}}")

    @pytest.mark.parametrize(
        ("request_line", "operation", "expected"),
        [
            ("DELETE /agents/enroll", "unpair_agent", Match.FULL),
            ("GET /agents/enroll", "enroll_agent", Match.PARTIAL),
            ("GET /devices/d/actions", "list_actions", Match.FULL),
            ("GET /nothing", None, Match.NONE),
        ],
    )
    def test_a_request_tries_at_most_one_route(
        self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch, request_line: str, operation: str | None, expected: Match
    ) -> None:
        method, path = request_line.split()
        tried: list[APIRoute] = []
        original = APIRoute.matches

        def counted(route: APIRoute, scope: Scope) -> tuple[Match, Scope]:
            tried.append(route)
            return original(route, scope)

        monkeypatch.setattr(APIRoute, "matches", counted)
        match, found = cloud.app.state.route_index.matches({"type": "http", "method": method, "path": f"{API}{path}"})
        assert (match, getattr(found.get("route"), "operation_id", None)) == (expected, operation)
        assert len(tried) <= 1

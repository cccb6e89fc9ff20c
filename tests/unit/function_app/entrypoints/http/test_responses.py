"""Every answer of the API, also to what is wrong: problem details, security headers, and never a 500."""

import asyncio
import contextlib
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.routing import APIRoute
from starlette.routing import Match
from starlette.types import Scope

from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.framework.responses import MAX_BODY
from function_app.entrypoints.http.framework.responses import problem as problem_response
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import API, Cloud, Person, problem
from tests.harness.cloud.cloud import settings as cloud_settings

SIGN_IN = f"{API}/auth/sign-in"
DEVICE = "abcdefgh23-arm"
OPTIONAL_BODY = (f"/devices/{DEVICE}/lease", f"/devices/{DEVICE}/stop")
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
def test_a_wrong_body_is_a_problem_and_never_a_fault(anna: Person, path: str, body: bytes) -> None:
    answer = anna.request("PUT" if "/robot-types/" in path else "POST", path, content=body)
    if path in OPTIONAL_BODY and body == b"":
        problem(answer, 404, "device-unknown")
    else:
        problem(answer, 422, "invalid")


class TestBodySize:
    def test_a_body_of_a_million_bytes_is_read(self, cloud: Cloud) -> None:
        body = b'{"link":"x"}'
        problem(cloud.request("POST", SIGN_IN, content=body.ljust(MAX_BODY)), 401, "unauthorized")

    @pytest.mark.parametrize("length", ["1" * 5000, "-5", "x", "", "٣", "1, 2"])
    def test_a_declared_length_that_is_no_length_is_no_fault(self, cloud: Cloud, length: str) -> None:
        headers = {"content-length": length.encode()}
        answer = cloud.request("POST", SIGN_IN, content=b'{"link":"x"}', headers=headers)
        assert answer.status_code in {401, 413, 422}

    def test_a_caller_who_leaves_in_mid_body_is_no_fault(self, cloud: Cloud) -> None:
        sent: list[Any] = []

        async def leave() -> None:
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

        cloud.run(leave())
        assert not sent or sent[0]["status"] < 500


class TestErrors:
    @pytest.mark.parametrize(
        "path", ["/api", "/api/", "/api/v1", "/api/v1/nothing", "/api/v2/health", "/api/v1/health/"]
    )
    def test_what_is_not_there_is_a_problem(self, cloud: Cloud, path: str) -> None:
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
    def test_a_method_that_a_resource_has_not_is_405_and_says_which_it_has(
        self, cloud: Cloud, method: str, path: str, allowed: set[str]
    ) -> None:
        answer = cloud.request(method, API + path)
        problem(answer, 405, "http")
        assert set(answer.headers["allow"].split(", ")) == allowed

    def test_an_unhandled_error_is_a_problem_without_internals(
        self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        async def broken() -> None:
            raise RuntimeError("the secret inside")

        monkeypatch.setattr(cloud.functions.health, "check", broken, raising=True)
        answer = cloud.request("GET", f"{API}/health")
        problem(answer, 500, "internal")
        assert "secret" not in answer.text
        assert answer.headers["x-content-type-options"] == "nosniff"

    def test_tables_that_cannot_be_used_are_503_and_said_in_health(self, tmp_path: Path) -> None:
        with Cloud(cloud_settings(tmp_path)) as cloud:
            anna = cloud.sign_in("anna")
            cloud.run(cloud.functions.tables.close())
            (tmp_path / "tables.sqlite").write_bytes(b"no database " * 100)
            for name in ("tables.sqlite-wal", "tables.sqlite-shm"):
                (tmp_path / name).unlink(missing_ok=True)
            answer = anna.get("/devices")
            problem(answer, 503, "store-unavailable")
            assert answer.headers["retry-after"]
            assert str(tmp_path) not in answer.text
            assert "damaged" in problem(cloud.request("GET", f"{API}/health"), 503, "store-unavailable")["detail"]

    def test_a_refusal_carries_what_programs_need(self) -> None:
        answer = problem_response(Problem("x", 429, "T", "D.", retry_after_s=7, extras={"holder": "anna"}))
        assert answer.headers["retry-after"] == "7"
        assert bytes(answer.body) == b'{"type":"/problems/x","title":"T","status":429,"detail":"D.","holder":"anna"}'


class TestHeaders:
    @pytest.mark.parametrize(
        "path", ["/", "/assets/app-0123abcd.js", "/api/docs", "/api/v1/health", "/api/v1/devices", "/api/v1/nothing"]
    )
    def test_every_answer_has_them(self, cloud: Cloud, path: str) -> None:
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

    def test_every_answer_tells_the_time(self, tmp_path: Path) -> None:
        clock = MovingClock()
        with Cloud(cloud_settings(tmp_path), clock=clock) as cloud:
            clock.advance(1_000_000)
            for path in ("/api/v1/health", "/api/v1/devices", "/nothing"):
                told = int(cloud.request("GET", path).headers["x-telescope-time-ms"])
                assert abs(clock.now_ms() - told) < 20_000

    def test_no_other_origin_is_let_in(self, cloud: Cloud) -> None:
        answer = cloud.request("OPTIONS", f"{API}/devices", headers={"Origin": "https://evil.example"})
        assert answer.status_code == 405
        assert not [name for name in answer.headers if name.startswith("access-control-")]


class TestConsole:
    def test_the_page_is_asked_for_anew_and_its_assets_are_kept(self, cloud: Cloud) -> None:
        page = cloud.request("GET", "/")
        assert (page.status_code, page.headers["cache-control"]) == (200, "no-cache")
        again = cloud.request("GET", "/", headers={"If-None-Match": page.headers["etag"]})
        assert again.status_code == 304
        asset = cloud.request("GET", "/assets/app-0123abcd.js")
        assert asset.headers["cache-control"] == "public, max-age=31536000, immutable"
        assert cloud.request("HEAD", "/").status_code == 200
        problem(cloud.request("POST", "/"), 405, "http")

    def test_a_browser_finds_the_icon_where_no_page_names_it(self, cloud: Cloud) -> None:
        icon = cloud.request("GET", "/favicon.ico")
        assert (icon.status_code, icon.headers["content-type"]) == (200, "image/svg+xml")
        assert icon.headers["cache-control"] == "no-cache", "its address stays when it changes"

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
    def test_nothing_outside_its_folder_is_served(self, cloud: Cloud, path: str) -> None:
        answer = cloud.run(cloud.client().send(httpx.Request("GET", f"http://x{path}")))
        problem(answer, 404, "http")

    def test_a_console_that_was_not_built_says_so(self, tmp_path: Path) -> None:
        with Cloud(cloud_settings(tmp_path, console=tmp_path / "nothing")) as cloud:
            assert "make console" in problem(cloud.request("GET", "/"), 404, "http")["detail"]

    def test_a_websocket_is_refused_without_a_fault(self, cloud: Cloud) -> None:
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

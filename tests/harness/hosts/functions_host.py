"""``python -m tests.harness.hosts.functions_host WORKER``: a fake Azure Functions host.

The worker is Microsoft's (``azure-functions-runtime``): it indexes, loads and invokes the functions as in production.
This host converts each HTTP request to an invocation, and its result to a response. Functions observe the behaviour of
the real host: the route prefix of ``host.json``, header values joined with commas, a path that is decoded if it is
UTF-8 and encoded again, cookies as separate fields, and complete bodies. Prints its address.
"""

import asyncio
import http
import importlib
import json
import os
import re
import socket
import sys
import threading
import uuid
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote_to_bytes

import uvicorn

from tests.harness.hosts import rpc
from tests.harness.hosts.host import LOOPBACK
from tests.harness.paths import ROOT

_ADMIN = "/admin/functions/"
_EVENTS = "/runtime/webhooks/eventgrid"
_ACCEPTED = 202


class FunctionsHost:
    """The functions of a folder."""

    def __init__(self, folder: Path, worker: str) -> None:
        sys.path.append(worker)
        self._folder = folder
        self._worker = importlib.import_module("azure_functions_runtime")
        self._functions: dict[str, Any] = {}
        settings = json.loads((folder / "host.json").read_text(encoding="utf-8"))
        self._prefix = settings["extensions"]["http"]["routePrefix"]

    async def start(self) -> None:
        """Index and load all functions.

        Raises:
            SystemExit: No function exists, or one cannot be loaded.
        """
        init = rpc.record(capabilities={}, function_app_directory=str(self._folder))
        request = rpc.record(
            request=rpc.record(worker_init_request=init), properties={"host": LOOPBACK, "protos": rpc.PROTOS}
        )
        answer = await self._worker.worker_init_request(request)
        _check(answer.result)
        answer = await self._worker.functions_metadata_request(rpc.record())
        _check(answer.result)
        self._worker.start_threadpool_executor()
        for each in answer.function_metadata_results or ():
            load = rpc.record(function_id=each.function_id)
            _check(
                (
                    await self._worker.function_load_request(rpc.record(request=rpc.record(function_load_request=load)))
                ).result
            )
            (trigger,) = (
                binding for binding in map(json.loads, each.raw_bindings) if binding["type"].endswith("Trigger")
            )
            self._functions[each.name] = (each.function_id, trigger)
        if not self._functions:
            raise SystemExit("the worker found no functions")

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Serve one HTTP request."""
        body = b""
        more = True
        while more:
            message = await receive()
            body += message.get("body", b"")
            more = message.get("more_body", False)
        path = scope["path"]
        if path.startswith(_ADMIN):
            status, headers, content = await self._fire(path.removeprefix(_ADMIN))
        elif path == _EVENTS:
            status, headers, content = await self._events(scope, body)
        else:
            status, headers, content = await self._http(scope, body)
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else content})

    async def _http(self, scope: Any, body: bytes) -> "_Answer":
        path = _path(scope["raw_path"])
        if "\0" in path:
            return http.HTTPStatus.BAD_REQUEST, [], b""  # as Kestrel responds
        for function, trigger in self._functions.values():
            parameters = self._match(trigger, scope["method"], path)
            if parameters is not None:
                request = _request(scope, path, parameters, body)
                answer = await self._invoke(function, trigger["name"], rpc.TypedData(http=request))
                if answer.result.status == rpc.FAILED:
                    return http.HTTPStatus.INTERNAL_SERVER_ERROR, [], b""
                return _answer(answer.return_value.http)
        return http.HTTPStatus.NOT_FOUND, [], b""

    def _match(self, trigger: dict[str, Any], method: str, path: str) -> dict[str, str] | None:
        """The route's parameters, or ``None`` if the route does not match."""
        if trigger["type"] != "httpTrigger" or method not in trigger["methods"]:
            return None
        if trigger["authLevel"].lower() != "anonymous":
            raise SystemExit("a function requires a key of the host; only the product's tokens may decide")
        route = "/".join(part for part in (self._prefix, trigger["route"]) if part)
        parts = re.split(r"\{\*(\w+)\}", route)
        pattern = "".join(f"(?P<{part}>.*)" if number % 2 else re.escape(part) for number, part in enumerate(parts))
        found = re.fullmatch("/" + pattern, path, re.DOTALL)
        return None if found is None else found.groupdict()

    async def _fire(self, name: str) -> "_Answer":
        """Call a function without HTTP trigger, as the administration API does."""
        function, trigger = self._functions[name]
        status = {"Last": "2026-01-01T00:00:00", "Next": "2026-01-01T00:00:05", "LastUpdated": "2026-01-01T00:00:00"}
        timer = {"Schedule": {"AdjustForDST": True}, "ScheduleStatus": status, "IsPastDue": False}
        answer = await self._invoke(function, trigger["name"], rpc.TypedData(json=json.dumps(timer)))
        return _accepted(answer)

    async def _events(self, scope: Any, body: bytes) -> "_Answer":
        """Invoke the function for each event of an Event Grid push."""
        query = dict(part.split(b"=", 1) for part in scope["query_string"].split(b"&"))
        function, trigger = self._functions[query[b"functionName"].decode()]
        assert trigger["type"] == "eventGridTrigger"
        for event in json.loads(body):
            answer = await self._invoke(function, trigger["name"], rpc.TypedData(json=json.dumps(event)))
            if answer.result.status == rpc.FAILED:
                return _accepted(answer)
        return _ACCEPTED, [], b""

    async def _invoke(self, function: str, name: str, data: rpc.TypedData) -> Any:
        invocation = rpc.record(
            invocation_id=str(uuid.uuid4()),
            function_id=function,
            input_data=[rpc.Parameter(name, data)],
            trigger_metadata={},
            trace_context=rpc.record(trace_parent="", trace_state="", attributes={}),
            retry_context=rpc.record(retry_count=0, max_retry_count=0, exception=None),
        )
        answer = await self._worker.invocation_request(rpc.record(request=rpc.record(invocation_request=invocation)))
        if answer.result.status == rpc.FAILED:
            sys.stderr.write(f"{answer.result.exception.message}\n{answer.result.exception.stack_trace}\n")
        return answer


_Answer = tuple[int, list[tuple[bytes, bytes]], bytes]


def _check(result: Any) -> None:
    if result.status == rpc.FAILED:
        raise SystemExit(f"{result.exception.message}\n{result.exception.stack_trace}")


def _path(raw: bytes) -> str:
    """A request's path as Kestrel decodes it: parts that are not UTF-8 stay encoded."""

    def decode(found: re.Match[bytes]) -> bytes:
        plain = unquote_to_bytes(found[0])
        try:
            plain.decode()
        except UnicodeDecodeError:
            return found[0]
        return plain

    return re.sub(rb"(?:%[0-9A-Fa-f]{2})+", decode, raw).decode()


def _request(scope: Any, path: str, parameters: dict[str, str], body: bytes) -> Any:
    headers: dict[str, str] = {}
    for name, value in scope["headers"]:
        key, text = name.decode("latin-1").lower(), value.decode("latin-1")
        separator = "; " if key == "cookie" else ","
        headers[key] = f"{headers[key]}{separator}{text}" if key in headers else text
    query = scope["query_string"].decode("latin-1")
    url = f"{scope['scheme']}://{headers.get('host', 'localhost')}{quote(path, safe=_UNQUOTED)}"
    return rpc.record(
        method=scope["method"],
        url=url + (f"?{query}" if query else ""),
        headers=headers,
        params=parameters,
        query={},
        body=rpc.TypedData(bytes=body) if body else rpc.TypedData(),
    )


_UNQUOTED = "/!$&'()*+,;=:@-._~"


def _answer(answer: Any) -> _Answer:
    headers = [(name.lower().encode("latin-1"), value.encode("latin-1")) for name, value in answer.headers.items()]
    headers += [(b"set-cookie", cookie.encode("latin-1")) for cookie in map(_cookie, answer.cookies or ())]
    content = answer.body.bytes if answer.body.WhichOneof("data") == "bytes" else answer.body.string.encode()
    return int(answer.status_code), headers, content


def _cookie(cookie: Any) -> str:
    """A ``Set-Cookie`` header in ASP.NET's format."""
    parts = [f"{cookie.name}={quote(cookie.value, safe='')}"]
    plain: tuple[tuple[str, Any], ...] = (
        ("max-age", cookie.max_age and int(cookie.max_age.value)),
        ("domain", cookie.domain and cookie.domain.value),
        ("path", cookie.path and cookie.path.value),
    )
    parts += [f"{name}={value}" for name, value in plain if value not in (None, "")]
    parts += ["secure"] if cookie.secure and cookie.secure.value else []
    parts += [f"samesite={cookie.same_site}"] if cookie.same_site else []
    parts += ["httponly"] if cookie.http_only and cookie.http_only.value else []
    return "; ".join(parts)


def _accepted(answer: Any) -> _Answer:
    if answer.result.status == rpc.FAILED:
        return http.HTTPStatus.INTERNAL_SERVER_ERROR, [], answer.result.exception.message.encode()
    return _ACCEPTED, [], b""


async def main() -> None:
    """Serve until standard input ends."""
    host = FunctionsHost(ROOT, sys.argv[1])
    await host.start()
    listener = socket.create_server((LOOPBACK, 0))
    print(f"http://{LOOPBACK}:{listener.getsockname()[1]}", flush=True)  # noqa: T201
    await uvicorn.Server(
        uvicorn.Config(host, lifespan="off", access_log=False, server_header=False, log_level="warning")
    ).serve(sockets=[listener])


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    asyncio.run(main())

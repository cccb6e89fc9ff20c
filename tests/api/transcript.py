"""A transcript of requests and responses that is equal in equal runs.

Ids are replaced by the order of their appearance, times and secrets by placeholders.
"""

import json
import re
from typing import Any

import httpx

from tests.harness.cloud.cloud import API

_NAMED = frozenset({"id", "agent", "account", "session", "space", "action", "upload", "client_id", "public", "fault"})
"""Fields whose value is an id, which is also replaced inside other texts."""
_SECRET = frozenset(
    {"access_token", "csrf_token", "token", "claim_code", "password", "username", "url", "cursor", "key", "port",
     "broker", "websocket_url", "headers", "signature", "bins", "ms", "setpoint_key", "device_token", "pairing"}
)  # fmt: skip
_TIMES = ("_ms", "_at", "_in_s", "at")
_DURATIONS = frozenset({"lease_ms", "queue_ms", "ttl_ms", "timeout_ms", "wait_ms"})
"""Fields with durations, which are the same in each run."""
_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z")
_WAIT = re.compile(r"in \d+ s\b")
NO_CONTENT = 204
_HEADERS = ("content-type", "location", "allow", "www-authenticate", "cache-control", "x-content-type-options")


class Transcript:
    """One line for each request."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._ids: dict[str, str] = {}

    def add_name(self, value: str, name: str) -> None:
        """Replace a value by a name from now on."""
        self._ids.setdefault(value, f"<{name}>")

    def write(self, method: str, path: str, response: httpx.Response) -> None:
        """Add a request and its response."""
        body: Any = response.text
        if "json" in response.headers.get("content-type", "") and response.content:
            body = response.json()
            self._add_ids(body)
            body = self._masked(body)
        headers = {name: response.headers[name] for name in _HEADERS if name in response.headers}
        headers |= {name: "…" for name in ("retry-after", "x-telescope-time-ms") if name in response.headers}
        if response.status_code == NO_CONTENT:
            headers.pop("content-type", None)  # Amazon's gateway adds one to responses without content
        entry = [method, path.removeprefix(API), response.status_code, headers, body]
        self.lines.append(self._named(json.dumps(entry, ensure_ascii=False, sort_keys=True)))

    def _add_ids(self, value: Any) -> None:
        if isinstance(value, dict):
            for name, each in value.items():
                if name in _NAMED and isinstance(each, str) and each and each not in self._ids:
                    self._ids[each] = f"<{name} {len(self._ids)}>"
                self._add_ids(each)
        elif isinstance(value, list):
            for each in value:
                self._add_ids(each)

    def _masked(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self._masked(each) for each in value]
        if not isinstance(value, dict):
            return value
        return {
            name: "…"
            if each is not None and _hidden(name)
            else self._masked(json.loads(each) if name == "payload" else each)
            for name, each in value.items()
        }

    def _named(self, text: str) -> str:
        for value in sorted(self._ids, key=len, reverse=True):
            text = text.replace(value, self._ids[value])
        return _WAIT.sub("in … s", _TIME.sub("<time>", text))


def _hidden(name: str) -> bool:
    return name in _SECRET or (name.endswith(_TIMES) and name not in _DURATIONS)

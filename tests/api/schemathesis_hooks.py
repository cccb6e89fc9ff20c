"""Hooks that give schemathesis valid tokens and existing ids, so that requests pass 401 and 404.

The program ``schemathesis`` loads this module (``SCHEMATHESIS_HOOKS``). ``TELESCOPE_WORLD`` names a JSON file with the
resources at the tested API.
"""

import functools
import json
import os
import time
import zlib
from pathlib import Path
from typing import Any, Protocol

import jwt
import requests
import schemathesis
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from device_agent.protocol.security import signing

WORLD: dict[str, Any] = json.loads(Path(os.environ["TELESCOPE_WORLD"]).read_text(encoding="utf-8"))
REFRESH_S = 600
"""Renewal interval of access tokens, which expire after 15 min."""
_START_S = time.monotonic()
LONGEST_MS = 30_000
"""Longest wait that the API allows."""
MAX_WAIT_MS = 50
"""Longest wait of a test request. Longer waits would return the same response."""


class _Operation(Protocol):
    definition: Any


class _Case(Protocol):
    operation: _Operation
    path_parameters: Any
    query: Any
    headers: Any
    body: Any


def agent_token(name: str) -> str:
    """A request token of the agent with the key ``name``."""
    key: Any = load_pem_private_key(WORLD[name].encode(), None)
    now_s = int(time.time())
    claims = {"iss": "agent", "aud": "telescope/api", "iat": now_s, "exp": now_s + 60, "jti": str(time.time_ns())}
    return jwt.encode(claims, key, "EdDSA", headers={"kid": signing.key_id(key.public_key())})


@functools.cache
def _token_of(prefix: str, turn: int) -> str:
    """The access token of a session; another one for each turn."""
    if not turn:
        return str(WORLD[f"{prefix}token"])
    page = WORLD[f"{prefix}page"]
    headers = {"Cookie": page["cookie"], "X-CSRF-Token": page["csrf_token"]}
    response = requests.post(f"{WORLD['url']}/api/v1/auth/token", headers=headers, timeout=30)
    if response.ok:
        return str(response.json()["access_token"])
    return _token_of(prefix, turn - 1)  # a tested request has ended the session


def _token(prefix: str) -> str:
    """The current access token. The prefix ``spare_`` selects the session that is signed out."""
    return _token_of(prefix, int((time.monotonic() - _START_S) / REFRESH_S))


@schemathesis.auth(refresh_interval=None)
class Caller:
    """A token that the operation accepts."""

    def get(self, case: _Case, _context: object) -> str:
        operation = case.operation.definition.raw
        schemes = {name for each in operation.get("security", []) for name in each}
        for_agent = isinstance(case.body, dict) and case.body.get("purpose") == "agent"
        if "agentToken" in schemes and (for_agent or "accessToken" not in schemes):
            return agent_token("new_agent_key" if operation["operationId"] == "enroll_agent" else "agent_key")
        return _token("spare_" if operation["operationId"] == "sign_out" else "")

    def set(self, case: _Case, data: str, _context: object) -> None:
        case.headers = {**(case.headers or {}), "Authorization": f"Bearer {data}"}


@schemathesis.hook
def map_case(_context: object, case: _Case) -> _Case:
    """Replace most generated ids by existing ones, and long waits by short ones."""
    selector = zlib.crc32(repr((case.path_parameters, case.query, case.body)).encode())
    operation = case.operation.definition.raw["operationId"]
    for name, value in dict(case.path_parameters or {}).items():
        ids = WORLD["ids"].get(f"{operation}.{name}", WORLD["ids"].get(name, []))
        existing = WORLD["spare_agents"] if operation == "unpair_agent" else ids
        if existing and isinstance(value, str) and selector % 8:
            case.path_parameters[name] = existing[selector // 8 % len(existing)]
    for place in (case.query, case.body):
        if isinstance(place, dict):
            _replace(place, operation, selector)
    return case


def _replace(fields: dict[str, Any], operation: str, selector: int) -> None:
    wait_ms = str(fields.get("wait_ms"))
    if wait_ms.isdecimal() and MAX_WAIT_MS < int(wait_ms) <= LONGEST_MS:
        fields["wait_ms"] = int(wait_ms) % MAX_WAIT_MS
    if selector % 4:
        if isinstance(fields.get("device"), str):
            fields["device"] = WORLD["ids"]["name" if operation == "add_agent_latency" else "device"][0]
        if operation == "start_actions" and isinstance(fields.get("devices"), list):
            fields["devices"] = WORLD["ids"]["device"][: 1 + selector % 3]
        if operation == "enroll_agent" and isinstance(fields.get("public_key"), str):
            fields["public_key"] = WORLD["new_agent_public"]
        if operation in {"start_action", "start_actions"} and isinstance(fields.get("epoch"), int):
            fields["epoch"] = None
        movement = fields.get("request")
        if isinstance(movement, dict) and isinstance(movement.get("name"), str):
            fields["request"] = {"kind": "run_movement", "name": "wave"}

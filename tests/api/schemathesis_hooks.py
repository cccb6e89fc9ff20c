"""What makes schemathesis get beyond 401 and 404: tokens of the caller that an operation asks for, ids that exist.

Loaded by the program ``schemathesis`` itself (``SCHEMATHESIS_HOOKS``). ``TELESCOPE_WORLD`` names a JSON file that the
test wrote: what there is at the API under test.
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
TURN_S = 600
"""An access token lives for a quarter of an hour: a long run asks for the next one in time."""
_BEGUN_S = time.monotonic()
LONGEST_MS = 30_000
"""What the API allows."""
QUICK_MS = 50
"""No wait is longer: an answer that is waited for is the same one as at the end of a longer wait."""


class _Operation(Protocol):
    definition: Any


class _Case(Protocol):
    operation: _Operation
    path_parameters: Any
    query: Any
    headers: Any
    body: Any


def agent_token(name: str) -> str:
    """A request token of the agent that the world calls ``name``."""
    key: Any = load_pem_private_key(WORLD[name].encode(), None)
    now_s = int(time.time())
    claims = {"iss": "agent", "aud": "telescope/api", "iat": now_s, "exp": now_s + 60, "jti": str(time.time_ns())}
    return jwt.encode(claims, key, "EdDSA", headers={"kid": signing.key_id(key.public_key())})


@functools.cache
def _token_of(whose: str, turn: int) -> str:
    """The access token of a session; the next one at each turn."""
    if not turn:
        return str(WORLD[f"{whose}token"])
    page = WORLD[f"{whose}page"]
    headers = {"Cookie": page["cookie"], "X-CSRF-Token": page["csrf_token"]}
    answer = requests.post(f"{WORLD['url']}/api/v1/auth/token", headers=headers, timeout=30)
    if answer.ok:
        return str(answer.json()["access_token"])
    return _token_of(whose, turn - 1)  # the session was ended by what is tried here


def _token(whose: str) -> str:
    """Of a session; ``spare_``: of the one that is signed out."""
    return _token_of(whose, int((time.monotonic() - _BEGUN_S) / TURN_S))


@schemathesis.auth(refresh_interval=None)
class Caller:
    """A token that the operation accepts."""

    def get(self, case: _Case, _context: object) -> str:
        operation = case.operation.definition.raw
        schemes = {name for each in operation.get("security", []) for name in each}
        asks_for_agent = isinstance(case.body, dict) and case.body.get("purpose") == "agent"
        if "agentToken" in schemes and (asks_for_agent or "accessToken" not in schemes):
            return agent_token("new_agent_key" if operation["operationId"] == "enroll_agent" else "agent_key")
        return _token("spare_" if operation["operationId"] == "sign_out" else "")

    def set(self, case: _Case, data: str, _context: object) -> None:
        case.headers = {**(case.headers or {}), "Authorization": f"Bearer {data}"}


@schemathesis.hook
def map_case(_context: object, case: _Case) -> _Case:
    """Put what exists in place of most of what was made up, and ask for no long waits."""
    chance = zlib.crc32(repr((case.path_parameters, case.query, case.body)).encode())
    operation = case.operation.definition.raw["operationId"]
    for name, value in dict(case.path_parameters or {}).items():
        known = WORLD["spare_agents"] if operation == "unpair_agent" else WORLD["ids"].get(name, [])
        if known and isinstance(value, str) and chance % 8:
            case.path_parameters[name] = known[chance // 8 % len(known)]
    for place in (case.query, case.body):
        if isinstance(place, dict):
            _fit(place, operation, chance)
    return case


def _fit(fields: dict[str, Any], operation: str, chance: int) -> None:
    wait_ms = str(fields.get("wait_ms"))
    if wait_ms.isdecimal() and QUICK_MS < int(wait_ms) <= LONGEST_MS:
        fields["wait_ms"] = int(wait_ms) % QUICK_MS
    if chance % 4:
        if isinstance(fields.get("device"), str):
            fields["device"] = WORLD["ids"]["name" if operation == "add_agent_latency" else "device"][0]
        if operation == "start_actions" and isinstance(fields.get("devices"), list):
            fields["devices"] = WORLD["ids"]["device"][: 1 + chance % 3]
        if operation == "enroll_agent" and isinstance(fields.get("public_key"), str):
            fields["public_key"] = WORLD["new_agent_public"]
        if operation in {"start_action", "start_actions"} and isinstance(fields.get("epoch"), int):
            fields["epoch"] = None
        movement = fields.get("request")
        if isinstance(movement, dict) and isinstance(movement.get("name"), str):
            fields["request"] = {"kind": "run_movement", "name": "wave"}

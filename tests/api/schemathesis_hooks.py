"""What makes schemathesis get beyond 401 and 404: tokens of the caller that an operation asks for, ids that exist.

Loaded by the program ``schemathesis`` itself (``SCHEMATHESIS_HOOKS``). ``TELESCOPE_WORLD`` names a JSON file that the
test wrote: what there is at the API under test.
"""

import json
import os
import time
import zlib
from pathlib import Path
from typing import Any, Protocol

import jwt
import schemathesis
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from device_agent.protocol import signing

WORLD: dict[str, Any] = json.loads(Path(os.environ["TELESCOPE_WORLD"]).read_text(encoding="utf-8"))
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


@schemathesis.auth(refresh_interval=None)
class Caller:
    """A token of whoever the operation is for."""

    def get(self, case: _Case, _context: object) -> str:
        operation = case.operation.definition.raw
        schemes = {name for each in operation.get("security", []) for name in each}
        asks_for_agent = isinstance(case.body, dict) and case.body.get("purpose") == "agent"
        if "agentToken" in schemes and (asks_for_agent or "accessToken" not in schemes):
            return agent_token("new_agent_key" if operation["operationId"] == "enroll_agent" else "agent_key")
        spent: str = WORLD["spare_token" if operation["operationId"] == "sign_out" else "token"]
        return spent

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

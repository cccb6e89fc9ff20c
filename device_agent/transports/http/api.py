"""The few calls by which an agent becomes known to the cloud and gets its broker credentials."""

import time
import uuid
from dataclasses import dataclass
from typing import Any

import jwt
import requests
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.ports.clock import CloudClock, tick_ms
from device_agent.protocol import signing

_AUDIENCE = "telescope/api"
_TOKEN_LIFE_S = 60
_TIMEOUT_S = 10.0


class CloudError(ValueError):
    """The cloud said no, or something that is no answer. Its text is fit for a terminal.

    Attributes:
        code: The name of the refusal, as ``agent-unclaimed``; empty when it was no answer.
    """

    def __init__(self, message: str, code: str = "") -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class Claim:
    """What the agent waits for: a code to show, valid for ``expires_in_s`` [s]; no code once it is paired."""

    agent: str
    code: str | None
    expires_in_s: float


class CloudApi:
    """One agent's view of the HTTP API. Thread-safe for one call at a time.

    Args:
        server: Base address, ``http://host:port``.
        key: The agent's own private key; it never leaves this machine.
        clock: Learns the cloud's time from every answer.
    """

    def __init__(self, server: str, key: Ed25519PrivateKey, clock: CloudClock) -> None:
        self._base = server.rstrip("/") + "/api/v1"
        self._key = key
        self._clock = clock
        self._http = requests.Session()

    def enroll(self, *, name: str, software: str, transport: str, devices: list[dict[str, str]]) -> Claim:
        """Make the agent, its devices, and how it is to be reached known. Safe to repeat.

        Raises:
            CloudError: Refused.
            OSError: Not reached.
        """
        answer = self._call(
            "POST",
            "/agents/enroll",
            json={
                "name": name,
                "public_key": signing.public_text(self._key.public_key()),
                "software": software,
                "transport": transport,
                "devices": devices,
            },
        )
        return Claim(answer["agent"], answer.get("claim_code"), float(answer.get("expires_in_s") or 0))

    def enrollment(self, *, wait_s: float = 0.0) -> dict[str, Any]:
        """Whether somebody has claimed the agent: ``state``, ``space``, ``account``, ``keys``.

        Args:
            wait_s: How long the cloud may wait for it to happen before it answers [s].

        Raises:
            CloudError: Refused.
            OSError: Not reached.
        """
        wait = {"wait_ms": round(wait_s * 1000)} if wait_s else {}
        return self._call("GET", "/agents/enrollment", params=wait, timeout=_TIMEOUT_S + wait_s)

    def credentials(self) -> dict[str, Any]:
        """Short-lived broker credentials.

        Raises:
            CloudError: Refused; an agent that was un-paired learns it here.
            OSError: Not reached.
        """
        return self._call("POST", "/mqtt/credentials", json={"purpose": "agent"})

    def _call(self, method: str, path: str, *, timeout: float = _TIMEOUT_S, **request: Any) -> dict[str, Any]:
        sent = tick_ms()
        try:
            answer = self._http.request(
                method,
                self._base + path,
                headers={"Authorization": f"Bearer {self._token()}"},
                timeout=timeout,
                allow_redirects=False,
                **request,
            )
        except requests.RequestException as error:
            raise OSError(f"{self._base} cannot be reached: {_cause(error)}") from error
        received = tick_ms()
        server_ms = answer.headers.get("X-Telescope-Time-Ms", "")
        # An answer that was held back (long poll) says little about the moment it was asked for.
        if server_ms.isdecimal() and "wait_ms" not in (request.get("params") or {}):
            self._clock.observe(server_ms=int(server_ms), sent_tick_ms=sent, received_tick_ms=received)
        try:
            body = answer.json()
        except ValueError:
            body = None
        if not isinstance(body, dict):
            raise CloudError(
                f"{self._base}{path} answered {answer.status_code} without JSON: is it a Telescope server?"
            )
        if not answer.ok:
            code = str(body.get("type", "")).rpartition("/")[2]
            raise CloudError(str(body.get("detail") or body.get("title") or answer.reason), code)
        return body

    def _token(self) -> str:
        now = int(time.time())
        if (cloud_ms := self._clock.now_ms()) is not None:
            now = int(cloud_ms / 1000)
        claims = {"iss": "agent", "aud": _AUDIENCE, "iat": now, "exp": now + _TOKEN_LIFE_S, "jti": uuid.uuid4().hex}
        return jwt.encode(claims, self._key, "EdDSA", headers={"kid": signing.key_id(self._key.public_key())})


def _cause(error: BaseException) -> str:
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    return str(error)

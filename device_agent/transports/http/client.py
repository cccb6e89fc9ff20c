"""Client of the HTTP API for agents: enrollment, credentials, and messages for agents without a broker."""

import base64
import time
import uuid
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jwt
import msgspec
import requests
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from requests.auth import AuthBase

from device_agent.ports.clock import CloudClock, tick_ms
from device_agent.protocol import KINDS, PROTOCOL, Capabilities, VersionRange, incompatibility
from device_agent.protocol.security import signing
from device_agent.transports.http.session import Session

_AUDIENCE = "telescope/api"
_TOKEN_LIFE_S = 60
_TIMEOUT_S = 10.0
_CONNECT_S = 3.0
RESPONSE_TIMEOUT_S = 4.0
"""Timeout of polls and messages [s]; the cloud itself waits up to 2 s for an unavailable broker."""
_NO_CONTENT = 204
_SERVER_ERROR = 500
_TOO_MANY = 429


class CloudError(ValueError):
    """The cloud rejected a request, or its response is invalid. The message may be shown to users.

    Attributes:
        code: Code of the problem, such as ``agent-unclaimed``; empty for an invalid response.
        passing: Whether the problem may be temporary: the server is overloaded or failed.
    """

    def __init__(self, message: str, code: str = "", *, passing: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.passing = passing


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """Result of an enrollment: a claim code, valid for ``expires_in_s`` [s]; no code once the agent is paired.

    ``protocol`` and ``capabilities``: versions that the server supports, and the requests that it can send.
    """

    agent: str
    code: str | None = msgspec.field(default=None, name="claim_code")
    expires_in_s: float | None = None
    protocol: VersionRange = VersionRange()
    capabilities: Capabilities = ()


@dataclass(frozen=True, slots=True)
class QueuedCommand:
    """A command and its MQTT topic; the payload equals that over MQTT, byte for byte."""

    command: str
    topic: str
    payload: bytes


class CloudClient:
    """Client of one agent. One call at a time; ``abort`` at any time.

    Every call raises ``CloudError`` if the cloud rejects the request, and ``OSError`` if the cloud cannot be reached.
    ``TimeoutError``, an ``OSError``, means that the cloud has not responded in time.

    Args:
        server: URL of the server, ``http://host:port``.
        key: The agent's private key; it is never sent.
        clock: Updated with the cloud's time of each response.
        ca: Pinned authority of an ``https`` server; ``None``: the authorities of the operating system.
    """

    def __init__(self, server: str, key: Ed25519PrivateKey, clock: CloudClock, *, ca: Path | None = None) -> None:
        self.ca = ca
        self.server = server.rstrip("/") + "/"
        self._base = self.server + "api/v1"
        self._key = key
        self._clock = clock
        self._http = Session()

    def enroll(self, *, name: str, software: str, transport: str, devices: list[dict[str, str]]) -> Claim:
        """Register the agent, its devices and its transport. Idempotent.

        Raises:
            CloudError: Also ``protocol-unsupported``: no common version of the wire contract.
        """
        body: dict[str, Any] = {"name": name, "software": software, "transport": transport, "devices": devices}
        body["public_key"] = signing.public_text(self._key.public_key())
        body |= {"protocol": msgspec.to_builtins(PROTOCOL), "capabilities": KINDS}
        response = self._call("POST", "/agents/enroll", json=body)
        try:
            claim = msgspec.convert(response, Claim)
        except msgspec.ValidationError as error:
            raise CloudError(f"the cloud's response to the enrollment is invalid: {error}") from error
        if problem := incompatibility(agent=PROTOCOL, server=claim.protocol):
            raise CloudError(problem, "protocol-unsupported")
        return claim

    def enrollment(self, *, wait_s: float = 0.0, within_s: float = _TIMEOUT_S) -> dict[str, Any]:
        """State of the enrollment: ``state``, ``space``, ``account``, ``keys``.

        Args:
            wait_s: Long poll: the cloud waits for a claim up to this time [s].
            within_s: Additional timeout [s].
        """
        wait = {"wait_ms": round(wait_s * 1000)} if wait_s else {}
        return self._call("GET", "/agents/enrollment", params=wait, timeout=within_s + wait_s)

    def credentials(self) -> dict[str, Any]:
        """Short-lived broker credentials."""
        return self._call("POST", "/mqtt/credentials", json={"purpose": "agent"})

    def commands(self, agent: str, *, wait_s: float, limit: int, have: Collection[str]) -> list[QueuedCommand]:
        """Pending commands: Stop first, then the oldest.

        Args:
            agent: The agent's id.
            wait_s: Long poll: the cloud waits for a command up to this time [s].
            limit: Maximum number of commands.
            have: Ids of received commands, which are not sent again.
        """
        wait = {"wait_ms": round(wait_s * 1000)} if wait_s else {}
        query = {"limit": limit, "have": list(have), **wait}
        response = self._call("GET", f"/agents/{agent}/commands", params=query, timeout=RESPONSE_TIMEOUT_S + wait_s)
        try:
            return [QueuedCommand(item["id"], item["topic"], item["payload"].encode()) for item in response["items"]]
        except (KeyError, TypeError, AttributeError) as error:
            raise CloudError(f"the cloud's commands lack {error}") from error

    def send(
        self, agent: str, messages: Iterable[tuple[str, bytes]], *, within_s: float = RESPONSE_TIMEOUT_S
    ) -> list[str | None]:
        """Send messages: topics and JSON.

        Returns:
            For each message ``None`` if the cloud has stored it, otherwise why it is rejected permanently.

        Raises:
            OSError: No response: the messages may have been stored, and may be sent again.
        """
        parts = b",".join(b'{"topic":"%s","payload":%s}' % (topic.encode(), payload) for topic, payload in messages)
        response = self._call("POST", f"/agents/{agent}/messages", data=b'{"messages":[%s]}' % parts, timeout=within_s)
        try:
            return [None if result["status"] == "stored" else str(result["detail"]) for result in response["results"]]
        except (KeyError, TypeError) as error:
            raise CloudError(f"the cloud's response lacks {error}") from error

    def abort(self) -> None:
        """Abort the running call, which raises ``OSError``. Callable from any thread."""
        self._http.abort()

    def xmpp_credentials(self) -> dict[str, Any]:
        """Credentials for the XMPP server."""
        return self._call("POST", "/xmpp/credentials", json={"purpose": "agent"})

    def certificate(self, request: str) -> dict[str, Any]:
        """A client certificate for a request (PKCS 10, PEM)."""
        return self._call("POST", "/agents/certificate", json={"request": request})

    def robot_type(self, agent: str, name: str) -> tuple[bytes, dict[str, bytes]]:
        """The signed statement about a robot type of the agent's owner, and its files. Not verified."""
        response = self._call("GET", f"/agents/{agent}/robot-types/{name}")
        try:
            files = {file: base64.b64decode(text, validate=True) for file, text in response["files"].items()}
            return response["statement"].encode(), files
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise CloudError(f"the cloud's response is not a robot type: {error}") from error

    def post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """POST to a path below ``/api/v1``."""
        return self._call("POST", path, json=body)

    def _call(self, method: str, path: str, *, timeout: float = _TIMEOUT_S, **request: Any) -> dict[str, Any]:
        sent = tick_ms()
        try:
            response = self._http.request(
                method,
                self._base + path,
                auth=_Bearer(self._token()),
                timeout=(min(_CONNECT_S, timeout), timeout),
                allow_redirects=False,
                # Passed with each request: an environment variable would override that of the session.
                verify=True if self.ca is None else str(self.ca),
                **request,
            )
        except requests.Timeout as error:
            raise TimeoutError(f"{self._base} does not respond") from error
        except requests.RequestException as error:
            raise OSError(f"{self._base} cannot be reached: {_cause(error)}") from error
        received = tick_ms()
        server_ms = response.headers.get("X-Telescope-Time-Ms", "")
        # The response to a long poll was delayed, so its time is not comparable.
        if server_ms.isdecimal() and "wait_ms" not in (request.get("params") or {}):
            self._clock.observe(server_ms=int(server_ms), sent_tick_ms=sent, received_tick_ms=received)
        if response.status_code == _NO_CONTENT:
            return {}
        try:
            body = msgspec.json.decode(response.content)  # unlike ``response.json()`` it rejects NaN
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            body = None
        if not isinstance(body, dict):
            raise CloudError(
                f"{self._base}{path} responded {response.status_code} without JSON: is it a Telescope server?",
                passing=response.status_code >= _SERVER_ERROR,
            )
        if not response.ok:
            code = str(body.get("type", "")).rpartition("/")[2]
            passing = response.status_code >= _SERVER_ERROR or response.status_code == _TOO_MANY
            raise CloudError(str(body.get("detail") or body.get("title") or response.reason), code, passing=passing)
        return body

    def _token(self) -> str:
        now = int(time.time())
        if (cloud_ms := self._clock.now_ms()) is not None:
            now = int(cloud_ms / 1000)
        claims = {"iss": "agent", "aud": _AUDIENCE, "iat": now, "exp": now + _TOKEN_LIFE_S, "jti": uuid.uuid4().hex}
        return jwt.encode(claims, self._key, "EdDSA", headers={"kid": signing.key_id(self._key.public_key())})


class _Bearer(AuthBase):
    """Token of one request, passed as ``auth`` so that a ``.netrc`` entry cannot replace it."""

    def __init__(self, token: str) -> None:
        self._token = token

    def __call__(self, request: requests.PreparedRequest) -> requests.PreparedRequest:
        request.headers["Authorization"] = f"Bearer {self._token}"
        return request


def _cause(error: BaseException) -> str:
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    return str(error)

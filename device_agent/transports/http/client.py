"""The calls of an agent: to become known, to get broker credentials, and, without a broker, to hear and to tell."""

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
from device_agent.protocol.security import signing
from device_agent.transports.http.session import Session

_AUDIENCE = "telescope/api"
_TOKEN_LIFE_S = 60
_TIMEOUT_S = 10.0
_CONNECT_S = 3.0
ANSWER_WITHIN_S = 4.0
"""What is asked and told all the time is answered within this, or never: the cloud gives a broker that is away 2 s."""
_NO_CONTENT = 204
_SERVER_ERROR = 500
_TOO_MANY = 429


class CloudError(ValueError):
    """The cloud said no, or something that is no answer. Its text is fit for a terminal.

    Attributes:
        code: The name of the refusal, as ``agent-unclaimed``; empty when it was no answer.
        passing: Whether it may go better later: the server is busy or unwell.
    """

    def __init__(self, message: str, code: str = "", *, passing: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.passing = passing


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """What the agent waits for: a code to show, valid for ``expires_in_s`` [s]; no code once it is paired."""

    agent: str
    code: str | None = msgspec.field(default=None, name="claim_code")
    expires_in_s: float | None = None


@dataclass(frozen=True, slots=True)
class QueuedCommand:
    """A command as it would have come on ``topic`` over MQTT, byte for byte."""

    command: str
    topic: str
    payload: bytes


class CloudClient:
    """One agent's view of the HTTP API. One call at a time; ``break_off`` at any.

    Args:
        server: Base address, ``http://host:port``.
        key: The agent's own private key; it never leaves this machine.
        clock: Learns the cloud's time from every answer.
        ca: The authority that alone may speak for an ``https`` server; ``None``: those that the machine trusts.
    """

    def __init__(self, server: str, key: Ed25519PrivateKey, clock: CloudClock, *, ca: Path | None = None) -> None:
        self.ca = ca
        self.server = server.rstrip("/") + "/"
        self._base = self.server + "api/v1"
        self._key = key
        self._clock = clock
        self._http = Session()

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
        try:
            return msgspec.convert(answer, Claim)
        except msgspec.ValidationError as error:
            raise CloudError(f"the cloud's answer to the enrolment cannot be used: {error}") from error

    def enrollment(self, *, wait_s: float = 0.0, within_s: float = _TIMEOUT_S) -> dict[str, Any]:
        """Whether somebody has claimed the agent: ``state``, ``space``, ``account``, ``keys``.

        Args:
            wait_s: How long the cloud may wait for it to happen before it answers [s].
            within_s: How long after that an answer is waited for [s].

        Raises:
            CloudError: Refused.
            OSError: Not reached.
        """
        wait = {"wait_ms": round(wait_s * 1000)} if wait_s else {}
        return self._call("GET", "/agents/enrollment", params=wait, timeout=within_s + wait_s)

    def credentials(self) -> dict[str, Any]:
        """Short-lived broker credentials.

        Raises:
            CloudError: Refused, so to an agent that was un-paired.
            OSError: Not reached.
        """
        return self._call("POST", "/mqtt/credentials", json={"purpose": "agent"})

    def commands(self, agent: str, *, wait_s: float, limit: int, have: Collection[str]) -> list[QueuedCommand]:
        """Commands that wait for an answer: Stop first, then the oldest first.

        Args:
            agent: The agent's own id.
            wait_s: How long the cloud may wait for one [s].
            limit: At most so many.
            have: Ids of commands that are not to be given again.

        Raises:
            CloudError: Refused.
            TimeoutError: No answer in time.
            OSError: Not reached.
        """
        wait = {"wait_ms": round(wait_s * 1000)} if wait_s else {}
        asked = {"limit": limit, "have": list(have), **wait}
        answer = self._call("GET", f"/agents/{agent}/commands", params=asked, timeout=ANSWER_WITHIN_S + wait_s)
        try:
            return [QueuedCommand(item["id"], item["topic"], item["payload"].encode()) for item in answer["items"]]
        except (KeyError, TypeError, AttributeError) as error:
            raise CloudError(f"the cloud's commands lack {error}") from error

    def tell(
        self, agent: str, messages: Iterable[tuple[str, bytes]], *, within_s: float = ANSWER_WITHIN_S
    ) -> list[str | None]:
        """Tell messages, each a topic and JSON.

        Returns:
            For each message ``None`` once the cloud has stored it, else why it never will.

        Raises:
            CloudError: Refused altogether.
            TimeoutError: No answer in time: they may be stored or not, and may be told again.
            OSError: Not reached; as above.
        """
        parts = b",".join(b'{"topic":"%s","payload":%s}' % (topic.encode(), payload) for topic, payload in messages)
        answer = self._call(
            "POST",
            f"/agents/{agent}/messages",
            data=b'{"messages":[%s]}' % parts,
            timeout=within_s,
        )
        try:
            return [None if result["status"] == "stored" else str(result["detail"]) for result in answer["results"]]
        except (KeyError, TypeError) as error:
            raise CloudError(f"the cloud's answer lacks {error}") from error

    def break_off(self) -> None:
        """End the call that is under way: it raises ``OSError``. From any thread."""
        self._http.break_off()

    def xmpp_credentials(self) -> dict[str, Any]:
        """Credentials for the XMPP server.

        Raises:
            CloudError: Refused; an agent that was un-paired learns it here.
            OSError: Not reached.
        """
        return self._call("POST", "/xmpp/credentials", json={"purpose": "agent"})

    def certificate(self, request: str) -> dict[str, Any]:
        """A certificate for the broker, by a request (PKCS 10, PEM).

        Raises:
            CloudError: Refused.
            OSError: Not reached.
        """
        return self._call("POST", "/agents/certificate", json={"request": request})

    def post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """Any other call of an agent's, below ``/api/v1``.

        Raises:
            CloudError: Refused.
            OSError: Not reached.
        """
        return self._call("POST", path, json=body)

    def _call(self, method: str, path: str, *, timeout: float = _TIMEOUT_S, **request: Any) -> dict[str, Any]:
        sent = tick_ms()
        try:
            answer = self._http.request(
                method,
                self._base + path,
                auth=_Bearer(self._token()),
                timeout=(min(_CONNECT_S, timeout), timeout),
                allow_redirects=False,
                verify=True if self.ca is None else str(self.ca),  # said each time: a variable would win over less
                **request,
            )
        except requests.Timeout as error:
            raise TimeoutError(f"{self._base} does not answer") from error
        except requests.RequestException as error:
            raise OSError(f"{self._base} cannot be reached: {_cause(error)}") from error
        received = tick_ms()
        server_ms = answer.headers.get("X-Telescope-Time-Ms", "")
        # An answer that was held back (long poll) says little about the moment it was asked for.
        if server_ms.isdecimal() and "wait_ms" not in (request.get("params") or {}):
            self._clock.observe(server_ms=int(server_ms), sent_tick_ms=sent, received_tick_ms=received)
        if answer.status_code == _NO_CONTENT:
            return {}
        try:
            body = msgspec.json.decode(answer.content)  # unlike ``answer.json()`` it takes no NaN
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            body = None
        if not isinstance(body, dict):
            raise CloudError(
                f"{self._base}{path} answered {answer.status_code} without JSON: is it a Telescope server?",
                passing=answer.status_code >= _SERVER_ERROR,
            )
        if not answer.ok:
            code = str(body.get("type", "")).rpartition("/")[2]
            passing = answer.status_code >= _SERVER_ERROR or answer.status_code == _TOO_MANY
            raise CloudError(str(body.get("detail") or body.get("title") or answer.reason), code, passing=passing)
        return body

    def _token(self) -> str:
        now = int(time.time())
        if (cloud_ms := self._clock.now_ms()) is not None:
            now = int(cloud_ms / 1000)
        claims = {"iss": "agent", "aud": _AUDIENCE, "iat": now, "exp": now + _TOKEN_LIFE_S, "jti": uuid.uuid4().hex}
        return jwt.encode(claims, self._key, "EdDSA", headers={"kid": signing.key_id(self._key.public_key())})


class _Bearer(AuthBase):
    """The token of one request. As ``auth``, else a ``.netrc`` that names the server would win over it."""

    def __init__(self, token: str) -> None:
        self._token = token

    def __call__(self, request: requests.PreparedRequest) -> requests.PreparedRequest:
        request.headers["Authorization"] = f"Bearer {self._token}"
        return request


def _cause(error: BaseException) -> str:
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__  # type: ignore[assignment]
    return str(error)

"""A cloud with one robot for tests of the wrapper for legacy robots: signs commands and decodes messages strictly."""

import contextlib
import importlib.util
import itertools
import json
import threading
import time
from collections.abc import Iterable
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import jwt
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.ports.clock import wall_ms
from device_agent.protocol import Ack, Command, Description, Event, Presence, Request, State, codec, topics
from device_agent.protocol.security import signing
from tests.harness.network.brokers import wait_until
from tests.harness.network.http_server import QuietHandler
from tests.harness.paths import ROOT

WRAPPER = ROOT / "examples" / "legacy" / "telescope_legacy.py"
SPACE, AGENT, DEVICE = "lab", "robot1", "qbo"
KINDS: dict[str, type[Any]] = {
    topics.ACK: Ack,
    topics.STATE: State,
    topics.DESC: Description,
    topics.EVENT: Event,
    topics.CONN: Presence,
}


def load_wrapper() -> Any:
    """The module, imported from its file."""
    specification = importlib.util.spec_from_file_location("telescope_legacy", WRAPPER)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


class LegacyCloud:
    """The fake cloud.

    Attributes:
        key: Key that signs commands.
        statements: Statements of new keys in the response to the enrolment.
        messages: Received messages, decoded.
        samples: Received response times [ms].
        silent: Whether requests wait without a response.
        offset_ms: Cloud's clock minus the clock of this machine [ms].
    """

    def __init__(self) -> None:
        self.url = ""
        self.key = signing.generate()
        self.identity = signing.generate()
        self.statements: list[str] = []
        self.messages: list[Any] = []
        self.samples: list[float] = []
        self.silent = threading.Event()
        self.offset_ms = 0
        self._waiting: dict[str, str] = {}
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)

    def write_home(self, home: Path) -> None:
        """Write the folder of a paired robot."""
        home.mkdir(mode=0o700, exist_ok=True)
        public = signing.public_text(self.key.public_key())
        keys = {signing.key_id(self.key.public_key()): {"public": public, "until_ms": 0}}
        config = {"url": self.url, "seed": self.identity.private_bytes_raw().hex(), "ca": None}
        config |= {"name": DEVICE, "type": DEVICE, "label": "Qbo", "agent": AGENT, "space": SPACE}
        (home / "agent.json").write_text(json.dumps({**config, "keys": keys, "serial": 1}))

    def now_ms(self) -> int:
        return wall_ms() + self.offset_ms

    def sign(self, request: Request, *, key: Ed25519PrivateKey | None = None, **changes: Any) -> bytes:
        """A signed command; ``changes``: fields of the command."""
        fields: dict[str, Any] = {"space": SPACE, "agent": AGENT, "device": DEVICE, "caller": "anna", "epoch": 1}
        fields |= {"id": f"command-{next(self._numbers)}", "issued_at_ms": self.now_ms(), "ttl_ms": 30_000}
        return signing.sign(codec.encode(Command(**{**fields, **changes}, request=request)), key or self.key)

    def put(self, payload: bytes, entry: str = "") -> str:
        """Put a message into the mailbox; returns its id."""
        name = entry or f"entry-{next(self._numbers)}"
        with self._lock:
            self._waiting[name] = payload.decode()
        return name

    def send(self, request: Request, **changes: Any) -> str:
        """Send a command; returns its id."""
        payload = self.sign(request, **changes)
        name = str(json.loads(payload)["body"]["id"])
        return self.put(payload, name)

    def of(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.messages if isinstance(message, kind)]

    def acks(self, command: str) -> list[Ack]:
        return [ack for ack in self.of(Ack) if ack.id == command]

    def last(self, command: str) -> tuple[str, str]:
        """Status and code of the last ack of a command."""
        acks = self.acks(command)
        return (str(acks[-1].status), acks[-1].reason.code if acks[-1].reason else "") if acks else ("", "")

    def end(self, command: str) -> tuple[str, str]:
        """Status and code with which a command ends."""
        wait_until(lambda: any(ack.status.terminal for ack in self.acks(command)), f"the end of {command}")
        return self.last(command)

    def rejections(self) -> set[str]:
        return {event.data["code"] for event in self.of(Event) if event.kind == "command-rejected"}

    # ------------------------------------------------------------ HTTP

    def authenticate(self, header: str) -> bool:
        """Whether the token is valid at this cloud's time."""
        options: Any = {"verify_exp": False, "verify_iat": False}
        claims = jwt.decode(
            header.removeprefix("Bearer "),
            self.identity.public_key(),
            ["EdDSA"],
            audience="telescope/api",
            options=options,
        )
        return bool(claims["iat"] - 30 <= self.now_ms() / 1000 < claims["exp"] + 30)

    def respond(self, method: str, path: str, body: Any) -> Any:
        """The response of a request."""
        address = urlsplit(path)
        name = address.path.rpartition("/")[2]
        if name == "enrollment":
            return {"state": "claimed", "space": SPACE, "key_statements": self.statements, "signing_key": ""}
        if name == "enroll":
            return {"agent": AGENT, "claim_code": None}
        if name == "latency":
            self.samples += [sample["ms"] for sample in body["samples"]]
            return {}
        if method == "POST":
            return {"results": [self._store(each["topic"], each["payload"]) for each in body["messages"]]}
        query = parse_qs(address.query)
        return {"items": self._poll(query.get("have", []), int(query["wait_ms"][0]) / 1000)}

    def _poll(self, have: Iterable[str], wait_s: float) -> list[dict[str, str]]:
        end_s = time.monotonic() + wait_s
        while True:
            with self._lock:
                items = [{"id": name, "payload": text} for name, text in self._waiting.items() if name not in have]
            if items or time.monotonic() > end_s:
                return items
            time.sleep(0.005)

    def _store(self, topic: str, payload: Any) -> dict[str, str]:
        parsed = topics.parse(topic)
        assert (parsed.space, parsed.agent) == (SPACE, AGENT)
        message = codec.decode(json.dumps(payload).encode(), KINDS[parsed.kind])
        with self._lock:
            self.messages.append(message)
            if isinstance(message, Ack):
                self._waiting.pop(message.id, None)
        return {"status": "stored"}


def handler_of(cloud: LegacyCloud) -> type[QuietHandler]:
    """The handler of the fake cloud's HTTP server."""

    class Handler(QuietHandler):
        def handle_any(self) -> None:
            content = self.rfile.read(int(self.headers.get("Content-Length", "0")))
            if cloud.silent.is_set():
                time.sleep(30)
                return
            valid = cloud.authenticate(self.headers["Authorization"])
            problem = {"type": "/problems/unauthorized", "detail": "The token is not valid."}
            body = cloud.respond(self.command, self.path, json.loads(content or b"null")) if valid else problem
            status = HTTPStatus.OK if valid else HTTPStatus.UNAUTHORIZED
            with contextlib.suppress(ConnectionError):  # the wrapper aborts its poll when it ends
                self.respond(status, [("X-Telescope-Time-Ms", str(cloud.now_ms()))], json.dumps(body).encode())

    return Handler

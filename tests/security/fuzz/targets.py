"""Fuzz targets: each parser of untrusted input, with valid seed examples.

A target receives bytes. It allows only the parser's documented exceptions and checks that each parsed number is
finite and that a round trip through the serializer is stable.
"""

import atexit
import contextlib
import math
import shutil
import tempfile
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree.ElementTree import ParseError, fromstring

import msgspec
import requests
from amqtt.mqtt.packet import CONNECT, PUBACK, PUBLISH, SUBSCRIBE, UNSUBSCRIBE

from device_agent.config.agent_config import AgentConfig
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore
from device_agent.ports import script_calls
from device_agent.ports.clock import CloudClock
from device_agent.protocol import codec, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.shipped import ROBOTS
from device_agent.protocol.security import grants, signing
from device_agent.protocol.xmpp import stanzas
from device_agent.transports.http import responses
from device_agent.transports.http.client import CloudClient, CloudError
from function_app.domain.common.problems import Problem
from function_app.entrypoints.http.framework.responses import read
from infra.embedded_broker import packets
from infra.embedded_broker.limits import Limits
from infra.embedded_broker.packets import Framer, MalformedPacket, UnacceptableProtocol
from tests.security.fuzz import examples

_KEY = signing.generate()
_KEYS = {signing.key_id(_KEY.public_key()): _KEY.public_key()}


class Found(Exception):  # noqa: N818 (what a fuzzer is for)
    """The parser accepted invalid input."""


@dataclass(frozen=True, slots=True)
class Target:
    """One fuzzed parser.

    Attributes:
        try_out: Parses bytes; raises only if the parser is wrong.
        seeds: Valid examples.
    """

    try_out: Callable[[bytes], None]
    seeds: tuple[bytes, ...]


def _message(data: bytes) -> None:
    """The first byte selects the type."""
    if not data:
        return
    kind = examples.KINDS[data[0] % len(examples.KINDS)]
    try:
        found = codec.decode(data[1:], kind)
    except ProtocolError:
        return
    _check_finite(found)
    written = _written(found)
    if written is not None and (
        codec.decode(written, kind) != found or codec.encode(codec.decode(written, kind)) != written
    ):
        raise Found(f"{kind.__name__} is another one when it is written and read again")


def _written(found: Any) -> bytes | None:
    try:
        return codec.encode(found)
    except ProtocolError as error:
        if "is the most" in str(error):  # serialized, it is longer than the input
            return None
        raise Found(str(error)) from error


def _signed(data: bytes) -> None:
    try:
        body = signing.verify(data, _KEYS)
    except ProtocolError:
        return
    if body not in examples.BODIES:
        raise Found("an accepted body without a valid signature")


def _topic(data: bytes) -> None:
    text = data.decode(errors="replace")
    pattern, _, topic = text.partition(" ")
    try:
        parsed = topics.parse(topic)
    except ProtocolError:
        pass
    else:
        again = (
            topics.conn(parsed.space, parsed.agent)
            if parsed.kind == topics.CONN
            else topics.device(parsed.space, parsed.agent, parsed.device, parsed.kind, parsed.name)
        )
        if again != topic or not topics.matches(topic, topic):
            raise Found(f"{topic!r} was read as {parsed}")
    covered = topics.matches(pattern, topic)
    if covered and "#" not in pattern and len(pattern.split("/")) != len(topic.split("/")):
        raise Found(f"{pattern!r} covers {topic!r}")
    grant = grants.Grant(
        principal="p", client_id="c", publish=(pattern,), subscribe=(pattern,), token_id="t", expires_at=1
    )
    grant.may_publish(topic)
    grant.may_subscribe(topic)
    try:
        grants.check(grant)
    except ProtocolError:
        return


def _manifest(data: bytes) -> None:
    try:
        found = robot_type.parse(data.decode(errors="replace"))
    except ProtocolError:
        return
    _check_finite(found)


def _token(data: bytes) -> None:
    token = data.decode(errors="replace")
    try:
        found = grants.read(token, _KEYS)
    except ProtocolError:
        return
    _check_finite(found)
    grants.issued_at(token)


def _line_of_a_script(data: bytes) -> None:
    try:
        found = script_calls.parse(data)
    except ProtocolError:
        return
    _check_finite(found)


def _answer(data: bytes) -> None:
    """A server response to an agent: one byte for the status, one for the call, then the body."""
    if len(data) < 2:
        return
    clock = CloudClock()
    api = CloudClient("http://server", _KEY, clock)
    answer = requests.Response()
    answer.status_code = (200, 201, 202, 204, 302, 400, 404, 409, 429, 500, 503)[data[0] % 11]
    answer._content = data[2:]
    answer.headers["X-Telescope-Time-Ms"] = data[2:16].decode("latin-1")
    api._http.request = lambda *_arguments, **_options: answer  # type: ignore[method-assign]
    asked: tuple[Callable[[], Any], ...] = (
        lambda: api.enroll(name="n", software="s", transport="http", devices=[]),
        api.enrollment,
        api.credentials,
        lambda: api.commands("a", wait_s=0, limit=1, have=()),
        lambda: api.send("a", [("t", b"{}")]),
    )
    try:
        found = asked[data[1] % len(asked)]()
        _check_finite(found)
        if isinstance(found, dict):
            for kind in (responses.MqttCredentials, responses.XmppCredentials, responses.Claimed):
                with contextlib.suppress(CloudError):
                    _check_finite(responses.read(found, kind))
    except (CloudError, OSError):
        return
    _check_finite(clock.now_ms())


def _stanza(data: bytes) -> None:
    try:
        stanza = fromstring(data)  # noqa: S314 (what slixmpp does with what arrives)
    except (ParseError, ValueError, LookupError):
        return
    stanzas.receipt_id(stanza)
    stanzas.parse_rejection(stanza)
    stanzas.user_at(stanza.get("from", ""), "site")
    try:
        told = stanzas.parse(stanza)
    except ProtocolError:
        return
    if told is not None:
        again = stanzas.parse(fromstring(stanzas.message("a@site", told.topic, told.payload, receipt=told.id)))  # noqa: S314
        if again != told:
            raise Found(f"{told} is another one when it is written and read again: {again}")


_FOLDER = Path(tempfile.mkdtemp(prefix="ts-fuzz-"))
atexit.register(shutil.rmtree, _FOLDER, ignore_errors=True)


def _home(data: bytes) -> None:
    """Both files of an agent's folder."""
    store = IdentityStore(_FOLDER)
    (_FOLDER / "agent.toml").write_bytes(data)
    (_FOLDER / "pairing.json").write_bytes(data)
    with contextlib.suppress(ConfigError):
        _check_finite(store.pairing())
    try:
        found = AgentConfig.load(store.folder)
    except ConfigError:
        return
    _check_finite(found)
    found.save(store.folder)
    if AgentConfig.load(store.folder) != found:
        raise Found("the configuration is another one when it is written and read again")


class _Asked:
    """A request as the API's reader sees it."""

    def __init__(self, body: bytes) -> None:
        self.headers: dict[str, str] = {}
        self.state = SimpleNamespace()
        self._body = body

    async def stream(self) -> AsyncIterator[bytes]:
        yield self._body


def _body(data: bytes) -> None:
    """A request body; the first byte selects the type."""
    if not data:
        return
    asked: Any = _Asked(data[1:])
    reading = read(asked, examples.API_KINDS[data[0] % len(examples.API_KINDS)])
    try:
        reading.send(None)
    except StopIteration as done:
        _check_finite(done.value)
    except Problem:
        return


def _packet(data: bytes) -> None:
    """Packets at the broker: the first one, and those of an accepted client."""
    limits = Limits()
    accepted = Framer(limits)
    accepted.accept_all()
    for framer in (Framer(limits), accepted):
        try:
            frames = list(framer.feed(data))
        except MalformedPacket:
            continue
        for frame in frames:
            _read_frame(frame)


def _read_frame(frame: packets.Frame) -> None:
    readers: dict[int, Callable[[packets.Frame], Any]] = {
        CONNECT: lambda found: packets.read_connect(found.body),
        PUBLISH: packets.read_publish,
        SUBSCRIBE: packets.read_subscribe,
        UNSUBSCRIBE: packets.read_unsubscribe,
        PUBACK: packets.read_puback,
    }
    if frame.kind in readers:
        try:
            readers[frame.kind](frame)
        except (MalformedPacket, UnacceptableProtocol):
            return


def _check_finite(value: Any) -> None:
    match value:
        case float():
            if not math.isfinite(value):
                raise Found(f"{value} came out")
        case dict():
            _check_finite([*value, *value.values()])
        case list() | tuple():
            for item in value:
                _check_finite(item)
        case msgspec.Struct():
            _check_finite([getattr(value, field) for field in value.__struct_fields__])


def _manifests() -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in sorted(ROBOTS.glob(f"*/{robot_type.MANIFEST}")))


def _tokens() -> tuple[bytes, ...]:
    grant = grants.agent_grant("s", "a", token_id="t", lifetime_s=1e8)
    return (grants.issue(grant, _KEY).encode(),)


TARGETS: dict[str, Target] = {
    "messages": Target(_message, examples.MESSAGES),
    "signing": Target(_signed, tuple(signing.sign(body, _KEY) for body in examples.BODIES)),
    "topics": Target(_topic, examples.TOPICS),
    "robot_type": Target(_manifest, _manifests()),
    "grants": Target(_token, _tokens()),
    "script": Target(_line_of_a_script, examples.LINES),
    "http": Target(_answer, examples.ANSWERS),
    "stanzas": Target(_stanza, examples.STANZAS),
    "home": Target(_home, examples.HOMES),
    "bodies": Target(_body, examples.API_BODIES),
    "packets": Target(_packet, examples.PACKETS),
}

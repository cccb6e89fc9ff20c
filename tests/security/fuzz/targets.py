"""Fuzz targets: each parser of untrusted input, with valid seed examples.

A target receives bytes. It allows only the parser's documented exceptions and checks that each parsed number is
finite and that a round trip through the serializer is stable.
"""

import atexit
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


class Found(Exception):  # noqa: N818 (an outcome that the fuzzer expects)
    """The parser accepted invalid input."""


@dataclass(frozen=True, slots=True)
class Target:
    """One fuzzed parser.

    Attributes:
        run: Parses bytes; raises only if the parser has an error.
        seeds: Valid examples.
    """

    run: Callable[[bytes], None]
    seeds: tuple[bytes, ...]


def _parse(
    parse: Callable[..., Any],
    *arguments: Any,
    documented: type[Exception] | tuple[type[Exception], ...] = ProtocolError,
) -> Any:
    """The result of a parser, whose numbers are finite; ``None`` if it raised a documented exception."""
    try:
        result = parse(*arguments)
    except documented:
        return None
    _check_finite(result)
    return result


def _message(data: bytes) -> None:
    """The first byte selects the type."""
    if not data:
        return
    kind = examples.KINDS[data[0] % len(examples.KINDS)]
    message = _parse(codec.decode, data[1:], kind)
    if message is None:
        return
    try:
        encoded = codec.encode(message)
    except ProtocolError as error:
        if "is the most" in str(error):  # serialized, it is longer than the input
            return
        raise Found(str(error)) from error
    again = codec.decode(encoded, kind)
    if again != message or codec.encode(again) != encoded:
        raise Found(f"{kind.__name__} changes when it is serialized and parsed again")


def _signed(data: bytes) -> None:
    body = _parse(signing.verify, data, _KEYS)
    if body is not None and body not in examples.BODIES:
        raise Found("an accepted body without a valid signature")


def _topic(data: bytes) -> None:
    pattern, _, topic = data.decode(errors="replace").partition(" ")
    parsed = _parse(topics.parse, topic)
    if parsed is not None:
        again = (
            topics.conn(parsed.space, parsed.agent)
            if parsed.kind == topics.CONN
            else topics.device(parsed.space, parsed.agent, parsed.device, parsed.kind, parsed.name)
        )
        if again != topic or not topics.matches(topic, topic):
            raise Found(f"{topic!r} was parsed as {parsed}")
    covered = topics.matches(pattern, topic)
    if covered and "#" not in pattern and len(pattern.split("/")) != len(topic.split("/")):
        raise Found(f"{pattern!r} covers {topic!r}")
    grant = grants.Grant(
        principal="p", client_id="c", publish=(pattern,), subscribe=(pattern,), token_id="t", expires_at=1
    )
    grant.may_publish(topic)
    grant.may_subscribe(topic)
    _parse(grants.check, grant)


def _manifest(data: bytes) -> None:
    _parse(robot_type.parse, data.decode(errors="replace"))


def _token(data: bytes) -> None:
    token = data.decode(errors="replace")
    if _parse(grants.read, token, _KEYS) is not None:
        grants.issued_at(token)


def _script_line(data: bytes) -> None:
    _parse(script_calls.parse, data)


def _response(data: bytes) -> None:
    """A server's response to an agent: one byte for the status, one for the call, then the body."""
    if len(data) < 2:
        return
    clock = CloudClock()
    api = CloudClient("http://server", _KEY, clock)
    response = requests.Response()
    response.status_code = (200, 201, 202, 204, 302, 400, 404, 409, 429, 500, 503)[data[0] % 11]
    response._content = data[2:]
    response.headers["X-Telescope-Time-Ms"] = data[2:16].decode("latin-1")
    api._http.request = lambda *_arguments, **_options: response  # type: ignore[method-assign]
    calls: tuple[Callable[[], Any], ...] = (
        lambda: api.enroll(name="n", software="s", transport="http", devices=[]),
        api.enrollment,
        api.credentials,
        lambda: api.commands("a", wait_s=0, limit=1, have=()),
        lambda: api.send("a", [("t", b"{}")]),
    )
    result = _parse(calls[data[1] % len(calls)], documented=(CloudError, OSError))
    if isinstance(result, dict):
        for kind in (responses.MqttCredentials, responses.XmppCredentials, responses.Claimed):
            _parse(responses.read, result, kind, documented=CloudError)
    _check_finite(clock.now_ms())


def _stanza(data: bytes) -> None:
    try:
        stanza = fromstring(data)  # noqa: S314 (slixmpp does the same with received data)
    except (ParseError, ValueError, LookupError):
        return
    stanzas.receipt_id(stanza)
    stanzas.parse_rejection(stanza)
    stanzas.user_at(stanza.get("from", ""), "site")
    delivery = _parse(stanzas.parse, stanza)
    if delivery is not None:
        text = stanzas.message("a@site", delivery.topic, delivery.payload, receipt=delivery.id)
        again = stanzas.parse(fromstring(text))  # noqa: S314
        if again != delivery:
            raise Found(f"{delivery} changes when it is serialized and parsed again: {again}")


_FOLDER = Path(tempfile.mkdtemp(prefix="ts-fuzz-"))
atexit.register(shutil.rmtree, _FOLDER, ignore_errors=True)


def _home(data: bytes) -> None:
    """Both files of an agent's folder."""
    store = IdentityStore(_FOLDER)
    (_FOLDER / "agent.toml").write_bytes(data)
    (_FOLDER / "pairing.json").write_bytes(data)
    _parse(store.pairing, documented=ConfigError)
    config = _parse(AgentConfig.load, store.folder, documented=ConfigError)
    if config is not None:
        config.save(store.folder)
        if AgentConfig.load(store.folder) != config:
            raise Found("the configuration changes when it is serialized and parsed again")


class _Request:
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
    request: Any = _Request(data[1:])
    reading = read(request, examples.API_KINDS[data[0] % len(examples.API_KINDS)])
    try:
        reading.send(None)
    except StopIteration as done:
        _check_finite(done.value)
    except Problem:
        return


def _packet(data: bytes) -> None:
    """Packets at the broker: the first one, and those of an accepted client."""
    accepted = Framer(Limits())
    accepted.accept_all()
    for framer in (Framer(Limits()), accepted):
        for frame in _parse(lambda framer=framer: list(framer.feed(data)), documented=MalformedPacket) or ():
            _read_frame(frame)


def _read_frame(frame: packets.Frame) -> None:
    readers: dict[int, Callable[[packets.Frame], Any]] = {
        CONNECT: lambda frame: packets.read_connect(frame.body),
        PUBLISH: packets.read_publish,
        SUBSCRIBE: packets.read_subscribe,
        UNSUBSCRIBE: packets.read_unsubscribe,
        PUBACK: packets.read_puback,
    }
    if frame.kind in readers:
        _parse(readers[frame.kind], frame, documented=(MalformedPacket, UnacceptableProtocol))


def _check_finite(value: Any) -> None:
    match value:
        case float():
            if not math.isfinite(value):
                raise Found(f"{value} was accepted")
        case dict():
            _check_finite([*value, *value.values()])
        case list() | tuple():
            for item in value:
                _check_finite(item)
        case msgspec.Struct():
            _check_finite([getattr(value, field) for field in value.__struct_fields__])


_MANIFESTS = tuple(path.read_bytes() for path in sorted(ROBOTS.glob(f"*/{robot_type.MANIFEST}")))
_TOKEN = grants.issue(grants.agent_grant("s", "a", token_id="t", lifetime_s=1e8), _KEY).encode()
TARGETS: dict[str, Target] = {
    "messages": Target(_message, examples.MESSAGES),
    "signing": Target(_signed, tuple(signing.sign(body, _KEY) for body in examples.BODIES)),
    "topics": Target(_topic, examples.TOPICS),
    "robot_type": Target(_manifest, _MANIFESTS),
    "grants": Target(_token, (_TOKEN,)),
    "script": Target(_script_line, examples.LINES),
    "http": Target(_response, examples.RESPONSES),
    "stanzas": Target(_stanza, examples.STANZAS),
    "home": Target(_home, examples.HOMES),
    "bodies": Target(_body, examples.API_BODIES),
    "packets": Target(_packet, examples.PACKETS),
}

"""A client of Foxglove's WebSocket protocol that checks each message against the schema of its channel.

Protocol: https://github.com/foxglove/ws-protocol, subprotocol ``foxglove.sdk.v1``.
"""

import base64
import json
import struct
import time
from dataclasses import dataclass
from typing import Any, Final, Self

import foxglove.messages
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, unknown_fields
from google.protobuf.message import DecodeError, Message
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

PROTOCOL: Final = Subprotocol("foxglove.sdk.v1")
_MESSAGE_DATA: Final = 0x01
_HEADER: Final = struct.Struct("<BIQ")
_FORMATS: Final = {"jpeg", "png", "webp", "avif"}
"""Formats of ``foxglove.CompressedImage``."""


class SchemaError(AssertionError):
    """A message or a channel does not follow Foxglove's schemas."""


@dataclass(frozen=True)
class Channel:
    """An advertised channel: topic, name of its schema, and the class of its messages."""

    topic: str
    schema: str
    message: type[Message]


def read_channel(advertised: dict[str, Any]) -> Channel:
    """The advertised channel.

    Raises:
        SchemaError: Its schema is not that of Foxglove.
    """
    name = advertised["schemaName"]
    if (advertised["encoding"], advertised["schemaEncoding"]) != ("protobuf", "protobuf"):
        raise SchemaError(f"{advertised['topic']} is encoded as {advertised['encoding']}")
    content = base64.b64decode(advertised["schema"])
    known = getattr(foxglove.messages, name.removeprefix("foxglove."), None)
    if known is None or content != known.get_schema().data:
        raise SchemaError(f"{advertised['topic']} has the schema {name}, which is not Foxglove's")
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(content).file:
        pool.Add(file)
    return Channel(advertised["topic"], name, message_factory.GetMessageClass(pool.FindMessageTypeByName(name)))


def validate(channel: Channel, payload: bytes) -> Any:
    """The message.

    Raises:
        SchemaError: It has a field that the schema does not have, or a field of another type.
    """
    try:
        message = channel.message.FromString(payload)
    except DecodeError as error:
        raise SchemaError(f"{channel.topic}: {error}") from error
    _require_known_fields(channel, message)
    if channel.schema == "foxglove.CompressedImage" and message.format not in _FORMATS:
        raise SchemaError(f"{channel.topic}: the format is {message.format}")
    return message


def _require_known_fields(channel: Channel, message: Message) -> None:
    if len(unknown_fields.UnknownFieldSet(message)):
        raise SchemaError(f"{channel.topic}: {message.DESCRIPTOR.full_name} has a field that its schema does not have")
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in value if field.is_repeated else [value]:
                _require_known_fields(channel, part)


class FoxgloveClient:
    """Subscribes to every channel of an endpoint, and checks each received message."""

    def __init__(self, url: str) -> None:
        self._socket = connect(url, subprotocols=[PROTOCOL])
        assert self._socket.subprotocol == PROTOCOL
        self._channels: dict[int, Channel] = {}
        self.received: dict[str, list[Any]] = {}
        self.schemas: dict[str, str] = {}
        self.server: dict[str, Any] = {}
        self.closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def receive(self, until: Any, what: str, within_s: float = 60.0) -> None:
        """Receive messages until a condition holds.

        Raises:
            SchemaError: A channel or a message does not follow Foxglove's schemas.
        """
        end_s = time.monotonic() + within_s
        while not until():
            assert time.monotonic() < end_s, f"no {what}; received {sorted(self.received)}"
            try:
                content = self._socket.recv(timeout=0.2)
            except TimeoutError:
                continue
            except ConnectionClosed:
                self.closed = True
                assert until(), f"the endpoint closed the connection before {what}"
                return
            self._handle(content)

    def _handle(self, content: str | bytes) -> None:
        if isinstance(content, bytes):
            if content[0] == _MESSAGE_DATA:
                _, subscription, _ = _HEADER.unpack_from(content)
                channel = self._channels[subscription]
                message = validate(channel, content[_HEADER.size :])
                self.received.setdefault(channel.topic, []).append(message)
            return
        message = json.loads(content)
        if message["op"] == "serverInfo":
            self.server = message
        elif message["op"] == "advertise":
            for advertised in message["channels"]:
                channel = read_channel(advertised)
                self._channels[advertised["id"]] = channel
                self.schemas[channel.topic] = channel.schema
                wanted = {"id": advertised["id"], "channelId": advertised["id"]}
                self._socket.send(json.dumps({"op": "subscribe", "subscriptions": [wanted]}))

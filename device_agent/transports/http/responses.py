"""Typed responses of the cloud; invalid responses are rejected as a whole."""

from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, Struct

from device_agent.protocol import Id
from device_agent.protocol.fields import Milliseconds
from device_agent.protocol.security.key_rotation import PublicKeyText, Serial, Statement
from device_agent.transports.http.client import CloudError

Port = Annotated[int, Meta(ge=1, le=65_535)]
Lifetime = Annotated[float, Meta(gt=0)]
T = TypeVar("T")


class Address(Struct, frozen=True, kw_only=True):
    """Address of an MQTT broker. It may require a client certificate newer than ``certificate_after_ms``."""

    host: str
    port: Port
    tls: bool = False
    certificate_after_ms: Milliseconds | None = None


class MqttCredentials(Struct, frozen=True, kw_only=True):
    """Broker credentials, valid for ``lifetime_s`` from now on [s].

    ``confirmations``: topics on which the server confirms stored messages; ``None``: an older server does not.
    """

    tcp: Address
    client_id: str
    username: str
    password: str
    subscribe: tuple[str, ...]
    lifetime_s: Lifetime
    confirmations: str | None = None


class XmppCredentials(Struct, frozen=True, kw_only=True):
    """XMPP credentials, valid for ``lifetime_s`` from now on [s]; ``cloud`` is the JID of the cloud."""

    host: str
    port: Port
    jid: str
    password: str
    cloud: str
    lifetime_s: Lifetime


class Owner(Struct, frozen=True, kw_only=True):
    """The account that owns an agent."""

    id: str
    name: str


class Key(Struct, frozen=True, kw_only=True):
    """One of the cloud's public keys, valid until ``until_ms``; 0: no end yet."""

    id: str
    public: PublicKeyText
    serial: Serial = 1
    until_ms: Milliseconds = 0


class Claimed(Struct, frozen=True, kw_only=True):
    """Account and space of a claimed agent, and the keys to pin."""

    agent: Id
    space: Id
    account: Owner
    keys: tuple[Key, ...]

    @property
    def serial(self) -> int:
        """Serial number of the newest key."""
        return max((key.serial for key in self.keys), default=1)


class Certificate(Struct, frozen=True, kw_only=True):
    """A client certificate of this agent, PEM."""

    chain: str


class KeyUpdate(Struct, frozen=True, kw_only=True):
    """Key rotations: statements that lead to the newest key, and the key that signs commands now."""

    key_statements: tuple[Statement, ...] = ()
    signing_key: str = ""


def read(answer: dict[str, Any], kind: type[T]) -> T:
    """Convert a response; unknown fields are ignored.

    Raises:
        CloudError: The response is invalid; the message names the field.
    """
    try:
        return msgspec.convert(answer, kind)
    except msgspec.ValidationError as error:
        raise CloudError(f"the cloud's response is invalid: {error}") from error

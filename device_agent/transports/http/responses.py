"""What the cloud answers to an agent, each as a type: whatever else comes is told as such, never obeyed by half."""

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
    """Where a broker takes MQTT. It may want a certificate of this agent, newer than ``certificate_after_ms``."""

    host: str
    port: Port
    tls: bool = False
    certificate_after_ms: Milliseconds | None = None


class MqttCredentials(Struct, frozen=True, kw_only=True):
    """Broker credentials, good for ``lifetime_s`` from now [s]."""

    tcp: Address
    client_id: str
    username: str
    password: str
    subscribe: tuple[str, ...]
    lifetime_s: Lifetime


class XmppCredentials(Struct, frozen=True, kw_only=True):
    """An XMPP login, good for ``lifetime_s`` from now [s]; ``cloud`` is who to speak with."""

    host: str
    port: Port
    jid: str
    password: str
    cloud: str
    lifetime_s: Lifetime


class Owner(Struct, frozen=True, kw_only=True):
    """The account that an agent belongs to."""

    id: str
    name: str


class Key(Struct, frozen=True, kw_only=True):
    """One of the cloud's public keys; it counts until ``until_ms``, 0: for now without an end."""

    id: str
    public: PublicKeyText
    serial: Serial = 1
    until_ms: Milliseconds = 0


class Claimed(Struct, frozen=True, kw_only=True):
    """Whose the agent is, and which keys to pin."""

    agent: Id
    space: Id
    account: Owner
    keys: tuple[Key, ...]

    @property
    def serial(self) -> int:
        """The newest key's."""
        return max((key.serial for key in self.keys), default=1)


class Certificate(Struct, frozen=True, kw_only=True):
    """A certificate of this agent's own, PEM."""

    chain: str


class News(Struct, frozen=True, kw_only=True):
    """Of the cloud's keys: statements that lead to the newest, and which of them orders are signed with now."""

    key_statements: tuple[Statement, ...] = ()
    signing_key: str = ""


def read(answer: dict[str, Any], kind: type[T]) -> T:
    """The answer as ``kind``; what else is in it is passed over.

    Raises:
        CloudError: It is not; the text says where.
    """
    try:
        return msgspec.convert(answer, kind)
    except msgspec.ValidationError as error:
        raise CloudError(f"the cloud's answer cannot be used: {error}") from error

"""The key ring: all signing keys in order, as stored in a file or in a vault's secret.

A retired key retains only its public key. This module accesses no file and no clock.
"""

from typing import Annotated, Self

import msgspec
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from msgspec import Meta, Struct
from msgspec.structs import replace

from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import key_rotation as keys
from device_agent.protocol.security import signing
from function_app.ports.signing_keys import RotationRefused

MAX_KEYS = 64
"""The oldest keys are removed first. Data that they signed must be saved again."""

_NEVER_MS = 2**62
_TimeMs = Annotated[int, Meta(ge=0)]


class RingError(ValueError):
    """The stored data are not a valid key ring; the text states the location."""


class RingKey(Struct, frozen=True, kw_only=True):
    """One key.

    Attributes:
        serial: Increases by one with each key.
        public: The public key, as ``signing.public_text``.
        private: The private key (PKCS 8, PEM); empty if the key is retired.
        devices_from_ms: Start of signing commands with this key.
        until_ms: End of validity of its signatures on tokens and commands; 0: no newer key exists.
        leaked: All signatures of this key are invalid.
        statement: The announcement to devices, signed by the previous key; empty for a first or retired key.
    """

    serial: keys.Serial
    public: keys.PublicKeyText
    private: str = ""
    devices_from_ms: _TimeMs = 0
    until_ms: _TimeMs = 0
    leaked: bool = False
    statement: str = ""

    @property
    def id(self) -> str:
        """The key id."""
        return signing.key_id(signing.public_key(self.public))

    def is_valid(self, now_ms: int) -> bool:
        """Whether its signatures are valid now."""
        return not self.leaked and (self.until_ms == 0 or now_ms < self.until_ms)


class Ring(Struct, frozen=True):
    """The keys, oldest first; the last one signs."""

    keys: Annotated[tuple[RingKey, ...], Meta(min_length=1, max_length=MAX_KEYS)]

    @classmethod
    def first(cls, key: Ed25519PrivateKey) -> Self:
        """A ring with one key."""
        return cls((RingKey(serial=1, public=signing.public_text(key.public_key()), private=pem(key)),))

    @classmethod
    def read(cls, text: str | bytes) -> Self:
        """Parse the result of ``text``.

        Raises:
            RingError: The text is not a valid ring.
        """
        try:
            ring = msgspec.json.decode(text, type=cls)
            serials = [key.serial for key in ring.keys]
            if serials != sorted(set(serials)):
                raise RingError("the serial numbers do not increase")
            for key in ring.keys:
                signing.public_key(key.public)
                if key.private and signing.public_text(private(key).public_key()) != key.public:
                    raise RingError(f"the public and private key {key.serial} do not match")
            if not ring.newest.private:
                raise RingError("the newest key has no private key")
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ProtocolError) as error:
            raise RingError(str(error)) from error
        return ring

    @property
    def text(self) -> str:
        """The ring in its stored format."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1).decode()

    @property
    def newest(self) -> RingKey:
        """The key that signs tokens and stored data."""
        return self.keys[-1]

    def for_devices(self, now_ms: int) -> RingKey:
        """The key that signs commands: the newest one that devices had time to learn."""
        learned = [key for key in self.keys if key.private and key.devices_from_ms <= now_ms]
        return learned[-1] if learned else self.newest

    def valid(self, now_ms: int) -> tuple[RingKey, ...]:
        """The keys whose signatures are valid now."""
        return tuple(key for key in self.keys if key.is_valid(now_ms))

    def statements(self, now_ms: int) -> tuple[str, ...]:
        """Announcements for devices that pin one of the valid keys, oldest first."""
        pairs = zip(self.keys, self.keys[1:], strict=False)
        return tuple(key.statement for before, key in pairs if key.statement and before.is_valid(now_ms))

    def next_change_ms(self, now_ms: int) -> int:
        """The time at which the role or validity of a key changes next."""
        times_ms = [time_ms for key in self.keys for time_ms in (key.devices_from_ms, key.until_ms) if time_ms > now_ms]
        return min(times_ms, default=_NEVER_MS)

    def rotated(self, key: Ed25519PrivateKey, *, now_ms: int, learn_ms: int, overlap_ms: int) -> "Ring":
        """The ring with an additional key, announced to devices by a statement of the previous key.

        Raises:
            RotationRefused: Devices are still learning the last key.
        """
        before = self.newest
        if before.devices_from_ms > now_ms:
            raise RotationRefused(before.devices_from_ms)
        ends_ms = now_ms + overlap_ms
        new = keys.NewKey(serial=before.serial + 1, key=signing.public_text(key.public_key()), former_until_ms=ends_ms)
        statement = signing.sign(codec.encode(new), private(before), context=keys.KEYS_CONTEXT).decode()
        former = tuple(replace(each, until_ms=_earlier(each.until_ms, ends_ms)) for each in self.keys)
        added = RingKey(
            serial=new.serial, public=new.key, private=pem(key), devices_from_ms=now_ms + learn_ms, statement=statement
        )
        return Ring((*former, added)[-MAX_KEYS:]).pruned(now_ms)

    def replaced(self, key: Ed25519PrivateKey, *, now_ms: int) -> "Ring":
        """The ring with a new key; all keys with a stored private key have leaked and become invalid immediately.

        No statement announces the new key: an attacker with the old key could also sign such a statement.
        """
        former = tuple(
            replace(each, leaked=each.leaked or bool(each.private), until_ms=_earlier(each.until_ms, now_ms))
            for each in self.keys
        )
        added = RingKey(serial=self.newest.serial + 1, public=signing.public_text(key.public_key()), private=pem(key))
        return Ring((*former, added)[-MAX_KEYS:]).pruned(now_ms)

    def pruned(self, now_ms: int) -> "Ring":
        """The ring without the private keys and statements that are no longer in use."""
        used = {self.for_devices(now_ms).serial, self.newest.serial}
        statements = set(self.statements(now_ms))
        keys_ = tuple(
            replace(
                key,
                private=key.private if key.serial in used or key.devices_from_ms > now_ms else "",
                statement=key.statement if key.statement in statements else "",
            )
            for key in self.keys
        )
        return Ring(keys_)


def pem(key: Ed25519PrivateKey) -> str:
    """A private key in its stored format."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    ).decode()


def from_pem(content: bytes) -> Ed25519PrivateKey:
    """Parse the result of ``pem``.

    Raises:
        RingError: It is not an Ed25519 private key.
    """
    try:
        key = serialization.load_pem_private_key(content, password=None)
    except (ValueError, TypeError) as error:
        raise RingError(f"not a private key: {error}") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise RingError("not an Ed25519 key")
    return key


def private(key: RingKey) -> Ed25519PrivateKey:
    """The private key.

    Raises:
        RingError: It is missing or damaged.
    """
    return from_pem(key.private.encode())


def public(keys_: tuple[RingKey, ...]) -> dict[str, Ed25519PublicKey]:
    """Public keys by key id."""
    parsed = [signing.public_key(key.public) for key in keys_]
    return {signing.key_id(key): key for key in parsed}


def _earlier(until_ms: int, ends_ms: int) -> int:
    return ends_ms if until_ms == 0 else min(until_ms, ends_ms)

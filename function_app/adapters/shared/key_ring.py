"""The ring: every signing key there has been, in order, as it is stored in a file or in a vault's secret.

Of a key that is no longer signed with only the public half is left. Nothing here opens anything or knows the time.
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
"""Of those that are long over the oldest go first: what they signed is to be saved again."""

_NEVER_MS = 2**62
_Moment = Annotated[int, Meta(ge=0)]


class RingError(ValueError):
    """What is stored is not a ring of keys; the text says where."""


class RingKey(Struct, frozen=True, kw_only=True):
    """One key.

    Attributes:
        serial: Rises by one with each key.
        public: Its public half, as ``signing.public_text``.
        private: PKCS 8, PEM; empty once nothing is signed with it any more.
        devices_from_ms: From then on orders to devices are signed with it, not with the one before.
        until_ms: Until then its signatures on tokens and orders count; 0: there is no later key.
        leaked: Nothing that it ever signed counts.
        statement: What tells devices of it, by the key before; empty where there is none or it is over.
    """

    serial: keys.Serial
    public: keys.PublicKeyText
    private: str = ""
    devices_from_ms: _Moment = 0
    until_ms: _Moment = 0
    leaked: bool = False
    statement: str = ""

    @property
    def id(self) -> str:
        """Its short name."""
        return signing.key_id(signing.public_key(self.public))

    def live(self, now_ms: int) -> bool:
        """Whether its signatures count now."""
        return not self.leaked and (self.until_ms == 0 or now_ms < self.until_ms)


class Ring(Struct, frozen=True):
    """The keys, oldest first; the last is the one to sign with."""

    keys: Annotated[tuple[RingKey, ...], Meta(min_length=1, max_length=MAX_KEYS)]

    @classmethod
    def first(cls, key: Ed25519PrivateKey) -> Self:
        """A ring of one."""
        return cls((RingKey(serial=1, public=signing.public_text(key.public_key()), private=pem(key)),))

    @classmethod
    def read(cls, text: str | bytes) -> Self:
        """What ``text`` wrote.

        Raises:
            RingError: It is not that.
        """
        try:
            found = msgspec.json.decode(text, type=cls)
            serials = [key.serial for key in found.keys]
            if serials != sorted(set(serials)):
                raise RingError("its serials do not rise")
            for key in found.keys:
                signing.public_key(key.public)
                if key.private and signing.public_text(private(key).public_key()) != key.public:
                    raise RingError(f"the halves of key {key.serial} do not belong together")
            if not found.newest.private:
                raise RingError("its newest key has no private half")
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ProtocolError) as error:
            raise RingError(str(error)) from error
        return found

    @property
    def text(self) -> str:
        """As it is stored."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1).decode()

    @property
    def newest(self) -> RingKey:
        """The key to sign tokens with, and what is stored."""
        return self.keys[-1]

    def for_devices(self, now_ms: int) -> RingKey:
        """The key that devices have had the time to learn."""
        known = [key for key in self.keys if key.private and key.devices_from_ms <= now_ms]
        return known[-1] if known else self.newest

    def live(self, now_ms: int) -> tuple[RingKey, ...]:
        """Those whose signatures count now."""
        return tuple(key for key in self.keys if key.live(now_ms))

    def statements(self, now_ms: int) -> tuple[str, ...]:
        """What a device is to be told that has pinned one of the live keys, oldest first."""
        after = zip(self.keys, self.keys[1:], strict=False)
        return tuple(key.statement for before, key in after if key.statement and before.live(now_ms))

    def next_change_ms(self, now_ms: int) -> int:
        """When something of it begins or ends next, by time alone."""
        moments = [moment for key in self.keys for moment in (key.devices_from_ms, key.until_ms) if moment > now_ms]
        return min(moments, default=_NEVER_MS)

    def rotated(self, key: Ed25519PrivateKey, *, now_ms: int, learn_ms: int, overlap_ms: int) -> "Ring":
        """Returns a ring with an additional key, announced to devices by a statement of the previous key.

        Raises:
            RotationRefused: Devices are still learning the last one.
        """
        before = self.newest
        if before.devices_from_ms > now_ms:
            raise RotationRefused(before.devices_from_ms)
        ends_ms = now_ms + overlap_ms
        new = keys.NewKey(serial=before.serial + 1, key=signing.public_text(key.public_key()), former_until_ms=ends_ms)
        statement = signing.sign(codec.encode(new), private(before), context=keys.KEYS_CONTEXT).decode()
        former = tuple(replace(each, until_ms=_sooner(each.until_ms, ends_ms)) for each in self.keys)
        added = RingKey(
            serial=new.serial, public=new.key, private=pem(key), devices_from_ms=now_ms + learn_ms, statement=statement
        )
        return Ring((*former, added)[-MAX_KEYS:]).pruned(now_ms)

    def replaced(self, key: Ed25519PrivateKey, *, now_ms: int) -> "Ring":
        """With a new key instead of all that are still stored whole: they have leaked, and end at once.

        No statement announces the new key: a thief of the old key could sign such a statement too.
        """
        former = tuple(
            replace(each, leaked=each.leaked or bool(each.private), until_ms=_sooner(each.until_ms, now_ms))
            for each in self.keys
        )
        added = RingKey(serial=self.newest.serial + 1, public=signing.public_text(key.public_key()), private=pem(key))
        return Ring((*former, added)[-MAX_KEYS:]).pruned(now_ms)

    def pruned(self, now_ms: int) -> "Ring":
        """Without the private halves that nothing is signed with any more, and the statements that are over."""
        used = {self.for_devices(now_ms).serial, self.newest.serial}
        told = set(self.statements(now_ms))
        kept = tuple(
            replace(
                key,
                private=key.private if key.serial in used or key.devices_from_ms > now_ms else "",
                statement=key.statement if key.statement in told else "",
            )
            for key in self.keys
        )
        return Ring(kept)


def pem(key: Ed25519PrivateKey) -> str:
    """A private key as it is stored."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    ).decode()


def from_pem(content: bytes) -> Ed25519PrivateKey:
    """What ``pem`` wrote.

    Raises:
        RingError: It is not that.
    """
    try:
        key = serialization.load_pem_private_key(content, password=None)
    except (ValueError, TypeError) as error:
        raise RingError(f"not a private key: {error}") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise RingError("not an Ed25519 key")
    return key


def private(key: RingKey) -> Ed25519PrivateKey:
    """Its private half, to sign with.

    Raises:
        RingError: There is none, or it is damaged.
    """
    return from_pem(key.private.encode())


def public(keys_: tuple[RingKey, ...]) -> dict[str, Ed25519PublicKey]:
    """Public halves by key id."""
    halves = [signing.public_key(key.public) for key in keys_]
    return {signing.key_id(half): half for half in halves}


def _sooner(until_ms: int, ends_ms: int) -> int:
    return ends_ms if until_ms == 0 else min(until_ms, ends_ms)

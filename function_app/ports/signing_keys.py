"""The cloud's own signing keys: for orders, access tokens and broker tokens. Files here, a vault in the cloud.

Keys follow one another with an overlap. From the moment of a rotation the new key signs tokens, and what is stored;
orders to devices only once these have had the time to learn it. The old one counts until the overlap is over.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

LEARN_MS = 2 * 3_600_000
"""Agents ask for broker credentials, and so for news of keys, once an hour at least; they are told by an order, too."""
OVERLAP_MS = 7 * 24 * 3_600_000
"""An agent that is off for longer must be told by hand."""


class RotationRefused(Exception):  # noqa: N818 (an answer, not always a fault)
    """Devices are still learning the last key, until ``until_ms``."""

    def __init__(self, until_ms: int) -> None:
        super().__init__("devices are still learning the last key")
        self.until_ms = until_ms


@dataclass(frozen=True, slots=True)
class PinnedKey:
    """A key as a device pins it: its place in the order of keys, and until when it counts (0: no end)."""

    id: str
    key: Ed25519PublicKey
    serial: int
    until_ms: int


@dataclass(frozen=True, slots=True)
class KeyAnnouncement:
    """What agents are told of keys.

    Attributes:
        pins: Keys whose orders a device is to obey, the newest last.
        statements: What leads a device from an older of them to the newest, each signed by the one before.
        signing: Id of the key that orders are signed with now.
    """

    pins: tuple[PinnedKey, ...]
    statements: tuple[str, ...]
    signing: str

    @property
    def serial(self) -> int:
        """The newest key's."""
        return self.pins[-1].serial


class SigningKeys(Protocol):
    """Ed25519 keys. Any number of processes use the same; each follows a rotation without a restart."""

    async def current(self) -> Ed25519PrivateKey:
        """The key to sign tokens with, and what is stored.

        Raises:
            StoreError: It cannot be read or written; the text names it.
        """

    async def for_devices(self) -> Ed25519PrivateKey:
        """The key to sign orders with: the newest that devices have had the time to learn."""

    async def public(self, wanted: str = "") -> Mapping[str, Ed25519PublicKey]:
        """Every key whose signature counts now, by ``signing.key_id``.

        Args:
            wanted: Id of a key that is looked for: where it is not known, it is looked whether there are new ones.
        """

    async def archive(self) -> Mapping[str, Ed25519PublicKey]:
        """Every key whose signature on what is stored counts: former ones too, unless they have leaked."""

    async def news(self) -> KeyAnnouncement:
        """What agents are told."""

    async def rotate(
        self, *, learn_ms: int = LEARN_MS, overlap_ms: int = OVERLAP_MS, leaked: bool = False
    ) -> KeyAnnouncement:
        """Make a new key, and let the present one end.

        Args:
            learn_ms: How long devices are given to learn it [ms].
            overlap_ms: How long the present one counts beside it [ms].
            leaked: It has leaked: it ends at once, and devices are told by nobody.

        Raises:
            RotationRefused: Devices are still learning the last one.
            StoreError: It cannot be written.
        """

    async def close(self) -> None:
        """Let go of connections."""

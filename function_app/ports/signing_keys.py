"""The cloud's signing keys for commands, access tokens and broker tokens: files, or a vault in the cloud.

Keys rotate with an overlap. After a rotation the new key immediately signs tokens and stored data. It signs commands
only after devices had time to learn it. The old key is valid until the overlap ends.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

LEARN_MS = 2 * 3_600_000
"""Time for devices to learn a key. Agents request broker credentials, and with them keys, at least hourly."""
OVERLAP_MS = 7 * 24 * 3_600_000
"""Overlap of two keys. An agent that is offline for longer must be updated manually."""


class RotationRefused(Exception):  # noqa: N818 (an answer, not always a fault)
    """A rotation is already in progress until ``until_ms``."""

    def __init__(self, until_ms: int) -> None:
        super().__init__("devices are still learning the last key")
        self.until_ms = until_ms


@dataclass(frozen=True, slots=True)
class PinnedKey:
    """A key as devices pin it: its serial number, and the end of its validity (0: no end)."""

    id: str
    key: Ed25519PublicKey
    serial: int
    until_ms: int


@dataclass(frozen=True, slots=True)
class KeyAnnouncement:
    """The keys that are announced to agents.

    Attributes:
        pins: Keys whose commands a device accepts, newest last.
        statements: Signed transitions from older keys to the newest, each signed by the previous key.
        signing: Id of the key that signs commands now.
    """

    pins: tuple[PinnedKey, ...]
    statements: tuple[str, ...]
    signing: str

    @property
    def serial(self) -> int:
        """Serial number of the newest key."""
        return self.pins[-1].serial


class SigningKeys(Protocol):
    """Ed25519 keys, shared by any number of processes. Each process follows a rotation without a restart.

    Rotation is atomic: a concurrent rotation raises ``RotationRefused``. Reading is cached. If the store is not
    reachable, calls raise ``StoreError``.

    Example::

        token = signing.sign(payload, await keys.current())
    """

    async def current(self) -> Ed25519PrivateKey:
        """The key that signs tokens and stored data.

        Raises:
            StoreError: The key cannot be read or written; the text names it.
        """

    async def for_devices(self) -> Ed25519PrivateKey:
        """The key that signs commands: the newest key that devices had time to learn."""

    async def public(self, wanted: str = "") -> Mapping[str, Ed25519PublicKey]:
        """All keys whose signatures are valid now, by ``signing.key_id``.

        An unknown key id in ``wanted`` causes the store to be read again.
        """

    async def archive(self) -> Mapping[str, Ed25519PublicKey]:
        """All keys whose signatures on stored data are valid: also former keys, except leaked ones."""

    async def announcement(self) -> KeyAnnouncement:
        """The keys to announce to agents."""

    async def rotate(
        self, *, learn_ms: int = LEARN_MS, overlap_ms: int = OVERLAP_MS, leaked: bool = False
    ) -> KeyAnnouncement:
        """Create a new key and schedule the end of the current one.

        Args:
            learn_ms: Time for devices to learn the new key [ms].
            overlap_ms: Time during which both keys are valid [ms].
            leaked: The current key has leaked: it becomes invalid immediately and is not announced.

        Raises:
            RotationRefused: Devices are still learning the last key.
            StoreError: The key cannot be written.
        """

    async def close(self) -> None:
        """Close all connections."""

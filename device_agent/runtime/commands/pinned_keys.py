"""Public keys of the cloud that the agent accepts: pinned at pairing, and followed when the cloud rotates them."""

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from msgspec.structs import replace

from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import Pairing
from device_agent.protocol import codec
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.security import key_rotation, setpoints, signing
from device_agent.protocol.security.key_rotation import NewKey
from device_agent.protocol.security.setpoints import SetpointKey, SetpointKeys
from device_agent.runtime.errors import Refused

_log = logging.getLogger(__name__)
ADVICE = "run `python -m device_agent repin` on this machine, or un-pair the agent and claim it again"


class PinnedKeys(Mapping[str, Ed25519PublicKey]):
    """Valid pinned keys by key id. Thread-safe: every device and the link use it.

    Args:
        pairing: With the stored keys.
        identity: The agent's private key.
        save: Stores the pairing; a new key is valid only after that.
        now_ms: The cloud's time [ms], or ``None`` while it is unknown. Then no key expires, but without the time the
            agent accepts only a Stop.
    """

    def __init__(
        self,
        pairing: Pairing,
        *,
        identity: Ed25519PrivateKey,
        save: Callable[[Pairing], None],
        now_ms: Callable[[], float | None],
    ) -> None:
        self._lock = threading.Lock()
        self._pairing = pairing
        self._identity = identity
        self._keys = pairing.public_keys()
        self._save = save
        self._now_ms = now_ms
        self._reported = ""

    def __getitem__(self, name: str) -> Ed25519PublicKey:
        with self._lock:
            key = self._keys[name]
            if self._expired(self._pairing, name):
                raise KeyError(name)
            return key

    def __iter__(self) -> Iterator[str]:
        with self._lock:
            names = [name for name in self._keys if not self._expired(self._pairing, name)]
        return iter(names)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    @property
    def serial(self) -> int:
        """Serial number of the newest key."""
        with self._lock:
            return self._pairing.serial

    def setpoint_keys(self, topic: str, pairing: str) -> SetpointKeys:
        """Keys that authenticate setpoints on ``topic``, one per valid pinned key; see ``setpoints.lease_key``."""
        keys = (setpoints.lease_key(self._identity, key, topic=topic, pairing=pairing) for key in self.values())
        return tuple(SetpointKey(key, topic) for key in keys)

    def follow(self, statements: Iterable[str]) -> None:
        """Pin the keys that the statements introduce, oldest first. Keys that are pinned already are skipped.

        Raises:
            Refused: Not signed with a valid pinned key, expired, or a return to an older key.
        """
        for statement in statements:
            with self._lock:
                self._follow(statement.encode())

    def check(self, name: str) -> None:
        """Log once if the cloud signs commands with a key that is not pinned."""
        if not name or name in self:
            return
        if self._reported != name:
            self._reported = name
            _log.error("the cloud signs commands with key %s, which this agent has not pinned: %s", name, ADVICE)

    def _follow(self, statement: bytes) -> None:
        before = self._pairing
        now_ms = self._now_ms()
        try:
            signer = codec.decode(statement, signing.Signed).key
            new = codec.decode(signing.verify(statement, self._keys, context=key_rotation.KEYS_CONTEXT), NewKey)
            key = signing.public_key(new.key)
        except SignatureError as error:
            if self._is_pinned(statement):
                return
            raise Refused("bad_signature", f"the statement of a new key is rejected: {error}; {ADVICE}") from error
        except ProtocolError as error:
            raise Refused("malformed", f"the statement of a new key is invalid: {error}") from error
        name = signing.key_id(key)
        if name in self._keys and new.serial <= before.serial:
            return
        if new.serial <= before.serial:
            raise Refused("rolled_back", f"key {new.serial} is not newer than key {before.serial}, which is pinned")
        if before.until_ms.get(signer):
            raise Refused("rolled_back", f"key {new.serial} is signed by a key that has a successor already; {ADVICE}")
        if now_ms is None:
            raise Refused("no_clock", "the device does not know the cloud's time yet; retry")
        if now_ms >= new.former_until_ms:
            raise Refused("expired", f"the key that signed the statement has expired; {ADVICE}")
        valid = {old: text for old, text in before.keys.items() if not self._expired(before, old)}
        pairing = replace(
            before,
            keys=valid | {name: new.key},
            until_ms={old: min(before.until_ms.get(old) or new.former_until_ms, new.former_until_ms) for old in valid},
            serial=new.serial,
        )
        try:
            self._save(pairing)
        except ConfigError as error:
            raise Refused("journal", f"the new key could not be stored: {error}") from error
        self._pairing, self._keys = pairing, pairing.public_keys()
        _log.info("the cloud has a new key, %s (number %d)", name, new.serial)

    def _is_pinned(self, statement: bytes) -> bool:
        """Whether a statement introduces a key that is pinned already; its signer may have expired since."""
        try:
            body = codec.decode(bytes(codec.decode(statement, signing.Signed).body), NewKey)
            name = signing.key_id(signing.public_key(body.key))
        except ProtocolError:
            return False
        return name in self._keys and body.serial <= self._pairing.serial

    def _expired(self, pairing: Pairing, name: str) -> bool:
        until_ms, now_ms = pairing.until_ms.get(name, 0), self._now_ms()
        return bool(until_ms) and now_ms is not None and now_ms >= until_ms

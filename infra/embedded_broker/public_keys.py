"""Public keys of those who may make tokens, read again when their file changes."""

import json
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import grants, signing
from device_agent.protocol.security.grants import Grant


class KeysError(Exception):
    """The file of keys cannot be used; the text says what is wrong with it."""


class KeyRing:
    """Keys by their id, from a JSON object ``{"key id": "base64url"}``."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, int, int] | None = None
        self._keys: dict[str, Ed25519PublicKey] = {}

    def refresh(self) -> bool:
        """Read the file when it is not as it was; keeps the keys it had where the new ones cannot be read.

        Returns:
            Whether there are other keys than before.

        Raises:
            KeysError: It has changed, and is gone or wrong.
        """
        try:
            stat = self._path.stat()
            stamp = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
            if stamp == self._seen:
                return False
            text = self._path.read_text()
        except OSError as error:
            if self._seen == (0, 0, 0):
                return False
            self._seen = (0, 0, 0)
            raise KeysError(f"cannot read the keys in {self._path}: {error.strerror}") from error
        self._seen = stamp
        keys = self._parse(text)
        changed = {name: signing.public_text(key) for name, key in keys.items()} != {
            name: signing.public_text(key) for name, key in self._keys.items()
        }
        self._keys = keys
        return changed

    def read(self, token: str) -> Grant:
        """The grant in a token.

        Raises:
            SignatureError: Expired, not a token, or not made by one of the keys.
        """
        return grants.read(token, self._keys)

    def _parse(self, text: str) -> dict[str, Ed25519PublicKey]:
        try:
            raw: Any = json.loads(text)
        except ValueError as error:
            raise KeysError(f"{self._path} is not JSON: {error}") from error
        if not isinstance(raw, dict) or not raw:
            raise KeysError(
                f'{self._path} must be a JSON object {{"key id": "public key in base64url"}} with one or more'
            )
        keys: dict[str, Ed25519PublicKey] = {}
        for name, value in raw.items():
            try:
                key = signing.public_key(str(value))
            except ProtocolError as error:
                raise KeysError(f"{self._path}: '{name}' is {error}") from error
            if signing.key_id(key) != name:
                raise KeysError(f"{self._path}: the id of key '{name}' is {signing.key_id(key)}")
            keys[name] = key
        return keys

"""Public keys of token issuers, reloaded when their file changes."""

import json
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import grants, signing
from device_agent.protocol.security.grants import Grant


class KeysError(Exception):
    """The key file cannot be used; the message gives the reason."""


class KeyRing:
    """Keys by id, from a JSON object ``{"key id": "base64url"}``."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._version: tuple[int, int, int] | None = None
        self._keys: dict[str, Ed25519PublicKey] = {}

    def refresh(self) -> bool:
        """Reload the file if it has changed; keeps the previous keys if the new ones cannot be read.

        Returns:
            Whether the keys have changed.

        Raises:
            KeysError: The changed file is missing or invalid.
        """
        try:
            stat = self._path.stat()
            version = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
            if version == self._version:
                return False
            text = self._path.read_text()
        except OSError as error:
            if self._version == (0, 0, 0):
                return False
            self._version = (0, 0, 0)
            raise KeysError(f"cannot read the keys in {self._path}: {error.strerror}") from error
        self._version = version
        keys = self._parse(text)
        previous, self._keys = self._keys, keys
        return keys != previous

    def read(self, token: str) -> Grant:
        """The grant in a token.

        Raises:
            SignatureError: Expired, invalid, or not signed by one of the keys.
        """
        return grants.read(token, self._keys)

    def _parse(self, text: str) -> dict[str, Ed25519PublicKey]:
        try:
            raw: Any = json.loads(text)
        except ValueError as error:
            raise KeysError(f"{self._path} is not JSON: {error}") from error
        if not isinstance(raw, dict) or not raw:
            raise KeysError(
                f'{self._path} must be a JSON object {{"key id": "public key in base64url"}} with at least one key'
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

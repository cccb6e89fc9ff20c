"""Signing keys in files: ``signing.pem`` (mode 0600) and ``public.json``, which the embedded broker reads."""

import contextlib
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from device_agent.protocol import signing
from device_agent.protocol.errors import ProtocolError
from function_app.ports.tables import StoreError

PRIVATE = "signing.pem"
PUBLIC = "public.json"


class FileKeys:
    """``Keys`` in ``folder``; made at first use."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._private: Ed25519PrivateKey | None = None
        self._public: Mapping[str, Ed25519PublicKey] = {}

    async def current(self) -> Ed25519PrivateKey:
        """See ``Keys``."""
        return self._private or self.load()

    async def public(self) -> Mapping[str, Ed25519PublicKey]:
        """See ``Keys``."""
        if self._private is None:
            self.load()
        return self._public

    def load(self) -> Ed25519PrivateKey:
        """Read the keys, and make them when there are none.

        Raises:
            StoreError: A file cannot be read or is not what it should be; the text names it.
        """
        path = self._folder / PRIVATE
        try:
            if not path.exists():
                self._make(path)
            private = serialization.load_pem_private_key(path.read_bytes(), password=None)
            if not isinstance(private, Ed25519PrivateKey):
                raise TypeError("not an Ed25519 key")  # noqa: TRY301 (one answer for every unusable file)
            self._public = self._publish(private.public_key())
        except (OSError, ValueError, TypeError, AttributeError, ProtocolError) as error:
            raise StoreError(f"the signing keys in {self._folder} cannot be used: {error}. Put back a copy.") from error
        self._private = private
        return private

    def _make(self, path: Path) -> None:
        """Of several processes that make a key at once, one wins: a link is made only where there is none."""
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        pem = signing.generate().private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        temporary = self._write_temporary(pem, 0o600)
        with contextlib.suppress(FileExistsError):
            os.link(temporary, path)
        temporary.unlink()

    def _publish(self, key: Ed25519PublicKey) -> Mapping[str, Ed25519PublicKey]:
        path = self._folder / PUBLIC
        known: dict[str, str] = json.loads(path.read_bytes()) if path.exists() else {}
        name = signing.key_id(key)
        if name not in known:
            known[name] = signing.public_text(key)
            self._write_temporary(json.dumps(known, indent=1).encode(), 0o644).replace(path)
        return {name: signing.public_key(text) for name, text in known.items()}

    def _write_temporary(self, content: bytes, mode: int) -> Path:
        path = self._folder / f"{secrets.token_hex(8)}.part"
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        return path

"""Signing keys in files: ``ring.json`` (mode 0600), and ``public.json``, which the embedded broker reads.

Each call checks whether the file has changed, which takes microseconds, so that a rotation by another process takes
effect immediately.
"""

import contextlib
import json
import logging
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security import signing
from function_app.adapters.local import atomic_files
from function_app.adapters.shared import key_ring
from function_app.adapters.shared.key_ring import Ring, RingError
from function_app.adapters.shared.key_ring_keys import RingKeys, wall_ms
from function_app.ports.tables import StoreError

RING = "ring.json"
PUBLIC = "public.json"
FORMER = "signing.pem"
"""File of the single key of earlier versions; becomes the first key of the ring."""
_LOCK = "ring.lock"
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_log = logging.getLogger(__name__)


class FileKeys(RingKeys):
    """``SigningKeys`` in ``folder``, which contains no other files. The first use creates it."""

    def __init__(self, folder: Path, *, now_ms: Callable[[], int] = wall_ms) -> None:
        super().__init__(now_ms=now_ms)
        self._folder = folder
        self._ring_file = folder / RING
        self._seen: tuple[int, int, int] | None = None
        self._read: Ring
        self._changes_ms = 0

    def load(self) -> Ed25519PrivateKey:
        """Read or create the keys, and restrict the files to this user.

        Raises:
            StoreError: A file cannot be read or is not valid; the text names it.
        """
        key = self.signer()
        with self._guarded():
            self._restrict_access()
        return key

    async def _ring(self, *, refresh: bool = False) -> Ring:
        del refresh  # reads are not cached
        return self._cached()

    async def _change(self, change: Callable[[Ring], Ring]) -> Ring:
        self._cached()
        with self._guarded(), self._locked():
            self._write(change(self._parse()))
        return self._cached()

    def _cached(self) -> Ring:
        """The ring in the file. Removes retired keys from the file and from the broker's public keys."""
        with self._guarded():
            if self._seen is None and not self._ring_file.exists():
                self._create()
            if self._stamp() != self._seen or self._now_ms() >= self._changes_ms:
                with self._locked():
                    stored = self._parse()
                    ring = stored.pruned(self._now_ms())
                    if ring != stored:
                        self._write(ring)
                    self._publish(ring)
                    self._read, self._seen = ring, self._stamp()
                    self._changes_ms = ring.next_change_ms(self._now_ms())
            return self._read

    def _stamp(self) -> tuple[int, int, int]:
        status = self._ring_file.stat()
        return status.st_mtime_ns, status.st_size, status.st_ino

    def _parse(self) -> Ring:
        return Ring.read(self._ring_file.read_bytes())

    def _create(self) -> None:
        """Create the ring. ``os.link`` fails if another process created it at the same time."""
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        former = self._folder / FORMER
        key = key_ring.from_pem(former.read_bytes()) if former.exists() else signing.generate()
        temporary = atomic_files.write_temporary(self._ring_file, Ring.first(key).text.encode(), mode=0o600)
        with contextlib.suppress(FileExistsError):
            os.link(temporary, self._ring_file)
        temporary.unlink()
        former.unlink(missing_ok=True)

    def _write(self, ring: Ring) -> None:
        atomic_files.write(self._ring_file, ring.text.encode(), mode=0o600)

    def _publish(self, ring: Ring) -> None:
        """Write the valid public keys for the embedded broker."""
        path = self._folder / PUBLIC
        public = {key.id: key.public for key in ring.valid(self._now_ms())}
        if not path.exists() or json.loads(path.read_bytes()) != public:
            atomic_files.write(path, json.dumps(public, indent=1).encode(), mode=0o644)

    def _restrict_access(self) -> None:
        """Remove access of other users. On Windows, the folder's access control applies."""
        if os.name == "nt":
            return
        for path, forbidden in (
            (self._folder, _OTHERS),
            (self._ring_file, _OTHERS),
            (self._folder / PUBLIC, _OTHERS_WRITE),
        ):
            if path.exists() and (mode := stat.S_IMODE(path.stat().st_mode)) & forbidden:
                path.chmod(mode & ~forbidden)
                _log.warning(
                    "removed access of other users to %s (mode was %03o); if another user may have read it, run "
                    "`python -m function_app rotate-keys --leaked`",
                    path,
                    mode,
                )

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError, TypeError, AttributeError, ProtocolError, RingError) as error:
            raise StoreError(
                f"the signing keys in {self._folder} cannot be used: {error}. Restore a backup."
            ) from error

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """An exclusive lock between processes. SQLite's lock is portable and is released when its process ends."""
        import sqlite3  # noqa: PLC0415 (only where something is written)

        with contextlib.closing(sqlite3.connect(self._folder / _LOCK, timeout=10, isolation_level=None)) as lock:
            try:
                lock.execute("BEGIN EXCLUSIVE")
            except sqlite3.Error as error:
                raise OSError(f"{self._folder / _LOCK}: {error}") from error
            yield

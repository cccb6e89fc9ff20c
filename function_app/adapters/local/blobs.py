"""Blobs as files. Names are encoded, so that none leaves the folder and every name is a file's name."""

import asyncio
import base64
import contextlib
import os
import secrets
from pathlib import Path
from urllib.parse import quote, unquote

from function_app.ports.blobs import MAX_BYTES, MAX_NAME_LENGTH
from function_app.ports.tables import StoreError

_PART = 120
"""An encoded name longer than this is cut into folders: file systems take 255 bytes a name."""
_READABLE = 3 * MAX_NAME_LENGTH
"""A path has at most 4,096 bytes: what percent signs would make longer than this is written in base64."""
_COMPACT = "~"
_TAIL = ".blob"
_TEMPORARY = ".part"


class FileBlobs:
    """``Blobs`` in ``folder``. Files are read and written in a thread: a disk may be slow, and blobs are large."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    async def put(self, name: str, content: bytes) -> None:
        """See ``Blobs``."""
        _check(content)
        await asyncio.to_thread(self._put, self._path(name), content)

    async def get(self, name: str) -> bytes | None:
        """See ``Blobs``."""
        return await asyncio.to_thread(self._get, self._path(name))

    async def append(self, name: str, content: bytes) -> None:
        """See ``Blobs``."""
        _check(content)
        await asyncio.to_thread(self._append, self._path(name), content)

    async def delete(self, name: str) -> None:
        """See ``Blobs``."""
        await asyncio.to_thread(self._delete, self._path(name))

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        """See ``Blobs``."""
        return await asyncio.to_thread(self._list, prefix, limit)

    async def close(self) -> None:
        """See ``Blobs``."""

    def _path(self, name: str) -> Path:
        if not 1 <= len(name) <= MAX_NAME_LENGTH:
            raise ValueError(f"a blob's name has 1 to {MAX_NAME_LENGTH} characters, not {len(name)}")
        encoded = _encode(name)
        parts = [encoded[start : start + _PART] for start in range(0, len(encoded), _PART)]
        return self._folder.joinpath(*(f"{part}+" for part in parts[:-1]), parts[-1] + _TAIL)

    def _put(self, path: Path, content: bytes) -> None:
        temporary = self._folder / f"{secrets.token_hex(8)}{_TEMPORARY}"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise _unusable(path, error) from error

    @staticmethod
    def _get(path: Path) -> bytes | None:
        try:
            return path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unusable(path, error) from error

    @staticmethod
    def _append(path: Path, content: bytes) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o600)
            try:
                written = 0
                while written < len(content):
                    written += os.write(descriptor, content[written:])
            finally:
                os.close(descriptor)
        except OSError as error:
            raise _unusable(path, error) from error

    @staticmethod
    def _delete(path: Path) -> None:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise _unusable(path, error) from error

    def _list(self, prefix: str, limit: int) -> tuple[str, ...]:
        names = []
        for path in self._folder.rglob(f"*{_TAIL}"):
            *folders, last = path.relative_to(self._folder).parts
            name = _decode("".join(part.removesuffix("+") for part in folders) + last.removesuffix(_TAIL))
            if name.startswith(prefix):
                names.append(name)
        return tuple(sorted(names)[:limit])


def _encode(name: str) -> str:
    """A name in characters that every file system takes: readable where it stays short enough."""
    try:
        text = name.encode()
    except UnicodeEncodeError as error:
        raise ValueError("a blob's name is Unicode text without lone surrogates") from error
    readable = quote(text, safe="").replace(".", "%2E").replace(_COMPACT, "%7E")
    if len(readable) <= _READABLE:
        return readable
    return _COMPACT + base64.urlsafe_b64encode(text).decode().rstrip("=")


def _decode(encoded: str) -> str:
    if not encoded.startswith(_COMPACT):
        return unquote(encoded)
    compact = encoded.removeprefix(_COMPACT)
    return base64.urlsafe_b64decode(compact + "=" * (-len(compact) % 4)).decode()


def _check(content: bytes) -> None:
    if len(content) > MAX_BYTES:
        raise ValueError(f"a blob holds at most {MAX_BYTES} bytes, not {len(content)}")


def _unusable(path: Path, error: OSError) -> StoreError:
    return StoreError(f"the blob {path} cannot be used: {error.strerror}. Check disk space and permissions.")

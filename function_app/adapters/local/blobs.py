"""Blobs as files. Names are encoded as valid file names, so that no blob is outside the folder.

Paths are strings: ``pathlib`` enters each part of a path in Python's table of interned strings, and removes it later.
A server with new names all the time thus fills and enlarges this table: in the laboratory by 1 MB after 40 minutes.
"""

import asyncio
import base64
import contextlib
import functools
import os
import secrets
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote, unquote

import jwt

from function_app.ports.blobs import (
    MAX_NAME_LENGTH,
    Download,
    TransferRefused,
    Upload,
    check_name,
    check_size,
    check_upload,
)
from function_app.ports.tables import StoreError

_PART = 120
"""An encoded name longer than this is split into folders: file systems limit a name to 255 bytes."""
_READABLE = 3 * MAX_NAME_LENGTH
"""Names whose percent encoding is longer than this are encoded in base64: a path has at most 4,096 bytes."""
_COMPACT = "~"
_SUFFIX = ".blob"
_FOLDER = "+"
_TEMPORARY = ".part"
_ABANDONED_S = 86_400
_SWEEP_S = 3600.0
_READ_BYTES = 1024 * 1024
_ALGORITHM = "HS256"
_UPLOAD = "telescope/blobs/upload"
_DOWNLOAD = "telescope/blobs/download"


class FileBlobs:
    """``Blobs`` in ``folder``. Reads and writes files in threads."""

    def __init__(
        self,
        folder: Path,
        *,
        keys: Callable[[], Sequence[bytes]] | None = None,
        url: str = "",
        is_full: Callable[[], bool] = lambda: False,
    ) -> None:
        """The first of ``keys`` signs presigned URLs below ``url``, where ``receive`` and ``send`` are served.

        ``receive`` ends an upload when ``is_full`` returns true.
        """
        self._is_full = is_full
        self._folder = os.fspath(folder)
        random_keys = (secrets.token_bytes(32),)
        self._keys = keys or (lambda: random_keys)
        self._url = url
        self._sweep_s = float("-inf")

    @property
    def origin(self) -> str:
        """None of its own: the functions serve the URLs."""
        return ""

    async def put(self, name: str, content: bytes) -> None:
        check_size(len(content))
        await asyncio.to_thread(self._put, self._path(name), content)

    async def get(self, name: str) -> bytes | None:
        return await asyncio.to_thread(self._get, self._path(name))

    async def append(self, name: str, content: bytes) -> None:
        check_size(len(content))
        await asyncio.to_thread(self._append, self._path(name), content)

    async def delete(self, name: str) -> None:
        await asyncio.to_thread(self._delete, self._path(name))

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        return await asyncio.to_thread(self._list, prefix, limit)

    async def size(self, name: str) -> int | None:
        path = self._path(name)
        try:
            return (await asyncio.to_thread(os.stat, path)).st_size
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unusable(path, error) from error

    async def presign_upload(self, name: str, *, length: int, content_type: str, lifetime_s: int) -> Upload:
        """See ``Blobs``. The functions serve the URL."""
        check_upload(length)
        self._path(name)
        claims = {"aud": _UPLOAD, "sub": name, "length": length, "type": content_type}
        headers = {"Content-Length": str(length), "Content-Type": content_type}
        return Upload("PUT", self._presigned_url(claims, lifetime_s), headers)

    async def presign_download(self, name: str, *, content_type: str, lifetime_s: int) -> str:
        self._path(name)
        return self._presigned_url({"aud": _DOWNLOAD, "sub": name, "type": content_type}, lifetime_s)

    async def receive(self, token: str, headers: Mapping[str, str], content: AsyncIterator[bytes]) -> None:
        claims = self._claims(token, _UPLOAD)
        length = claims["length"]
        if headers.get("content-length", str(length)) != str(length):
            raise TransferRefused(403, f"The URL is for exactly {length} bytes.")
        if headers.get("content-type") != claims["type"]:
            raise TransferRefused(403, f"The URL is for content of the type {claims['type']}.")
        path = self._path(claims["sub"])
        await asyncio.to_thread(self._prepare_upload, path)
        await asyncio.to_thread(self._delete_abandoned)
        temporary = self._temporary()
        try:
            if await self._write(temporary, content, length) != length:
                raise TransferRefused(400, f"The body must have {length} bytes.")
            await asyncio.to_thread(os.link, temporary, path)
        except FileExistsError as error:
            raise _exists_already() from error
        except OSError as error:
            raise _unusable(path, error) from error
        finally:
            with contextlib.suppress(OSError):
                await asyncio.to_thread(os.unlink, temporary)

    async def send(self, token: str) -> Download:
        claims = self._claims(token, _DOWNLOAD)
        path = self._path(claims["sub"])
        try:
            file = await asyncio.to_thread(open, path, "rb")
        except FileNotFoundError as error:
            raise TransferRefused(404, "The blob does not exist.") from error
        except OSError as error:
            raise _unusable(path, error) from error
        return Download(_parts(file), os.fstat(file.fileno()).st_size, claims["type"])

    def _presigned_url(self, claims: dict[str, Any], lifetime_s: int) -> str:
        token = jwt.encode({**claims, "exp": time.time() + lifetime_s}, self._keys()[0], _ALGORITHM)
        return f"{self._url}/{token}"

    def _claims(self, token: str, audience: str) -> dict[str, Any]:
        cause: Exception | None = None
        for key in self._keys():
            try:
                claims: dict[str, Any] = jwt.decode(
                    token, key, [_ALGORITHM], audience=audience, options={"require": ["exp", "aud", "sub"]}
                )
            except (jwt.PyJWTError, ValueError) as error:
                cause = error
            else:
                return claims
        raise TransferRefused(403, "The URL is invalid or expired. Request a new one.") from cause

    @staticmethod
    def _prepare_upload(path: str) -> None:
        if os.path.exists(path):
            raise _exists_already()
        os.makedirs(os.path.dirname(path), exist_ok=True)

    def _delete_abandoned(self) -> None:
        """Delete temporary files of interrupted uploads, at most once an hour: it reads the names of all blobs."""
        if time.monotonic() < self._sweep_s:
            return
        self._sweep_s = time.monotonic() + _SWEEP_S
        with contextlib.suppress(FileNotFoundError), os.scandir(self._folder) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):
                    if entry.name.endswith(_TEMPORARY) and time.time() - entry.stat().st_mtime > _ABANDONED_S:
                        os.unlink(entry)

    async def _write(self, path: str, content: AsyncIterator[bytes], max_length: int) -> int:
        """Write at most ``max_length`` bytes of the content; returns the number of received bytes."""
        length = 0
        with await asyncio.to_thread(open, path, "xb") as file:
            async for part in content:
                length += len(part)
                if length > max_length:
                    break
                if self._is_full():
                    raise TransferRefused(507, "The server's disk is almost full. Upload the content again later.")
                await asyncio.to_thread(file.write, part)
            await asyncio.to_thread(_flush, file)
        return length

    async def close(self) -> None:
        """See ``Blobs``."""

    def _path(self, name: str) -> str:
        return os.path.join(self._folder, _relative_path(name))

    def _temporary(self) -> str:
        return os.path.join(self._folder, f"{secrets.token_hex(8)}{_TEMPORARY}")

    def _put(self, path: str, content: bytes) -> None:
        temporary = self._temporary()
        try:
            os.makedirs(os.path.dirname(path), exist_ok=True)
            with open(temporary, "xb") as file:
                file.write(content)
                _flush(file)
            os.replace(temporary, path)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise _unusable(path, error) from error

    @staticmethod
    def _get(path: str) -> bytes | None:
        try:
            with open(path, "rb") as file:
                return file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unusable(path, error) from error

    @staticmethod
    def _append(path: str, content: bytes) -> None:
        try:
            os.makedirs(os.path.dirname(path), exist_ok=True)
            descriptor = os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o600)
            try:
                check_size(os.fstat(descriptor).st_size + len(content))
                written = 0
                while written < len(content):
                    written += os.write(descriptor, content[written:])
            finally:
                os.close(descriptor)
        except OSError as error:
            raise _unusable(path, error) from error

    @staticmethod
    def _delete(path: str) -> None:
        try:
            os.unlink(path)
        except FileNotFoundError:
            pass
        except OSError as error:
            raise _unusable(path, error) from error

    def _list(self, prefix: str, limit: int) -> tuple[str, ...]:
        # A readable name begins with its encoded prefix. A compact one must be decoded.
        found = _names(self._folder, "", (_percent_encoded(prefix), _COMPACT))
        names = [name for name in map(_decode, found) if name.startswith(prefix)]
        return tuple(sorted(names)[:limit])


def _names(folder: str, parents: str, prefixes: tuple[str, ...]) -> Iterator[str]:
    """The encoded names of the blobs below a folder that begin with one of the prefixes.

    ``parents`` is the part of these names that the folder and its parents stand for. Opens only folders of such names,
    and keeps one entry at a time: ``Path.rglob`` keeps all paths until its end.

    Raises:
        StoreError: The folder cannot be read. One that does not exist has no blobs.
    """
    try:
        entries = os.scandir(folder)
    except FileNotFoundError:
        return
    except OSError as error:
        raise _unusable(folder, error) from error
    with entries:
        for entry in entries:
            name = parents + entry.name.removesuffix(_SUFFIX).removesuffix(_FOLDER)
            if entry.name.endswith(_SUFFIX):
                if name.startswith(prefixes):
                    yield name
            elif entry.name.endswith(_FOLDER) and name.startswith(tuple(prefix[: len(name)] for prefix in prefixes)):
                yield from _names(entry.path, name, prefixes)


async def _parts(file: BinaryIO) -> AsyncGenerator[bytes, None]:
    # Closed without waiting: in a cancelled request each wait is cancelled, too.
    with file:
        while part := await asyncio.to_thread(file.read, _READ_BYTES):
            yield part


def _flush(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())


def _exists_already() -> TransferRefused:
    return TransferRefused(409, "The blob exists already and cannot be replaced.")


@functools.lru_cache(maxsize=256)
def _relative_path(name: str) -> str:
    """Where a blob is stored. Cached because an upload, its checks and its first reads use the same name."""
    check_name(name)
    encoded = _encode(name)
    parts = [encoded[start : start + _PART] for start in range(0, len(encoded), _PART)]
    return os.path.join(*(part + _FOLDER for part in parts[:-1]), parts[-1] + _SUFFIX)


def _encode(name: str) -> str:
    """A name in characters that every file system accepts; percent-encoded if short enough."""
    readable = _percent_encoded(name)
    if len(readable) <= _READABLE:
        return readable
    return _COMPACT + base64.urlsafe_b64encode(name.encode()).decode().rstrip("=")


def _percent_encoded(text: str) -> str:
    return quote(text.encode(), safe="").replace(".", "%2E").replace(_COMPACT, "%7E")


def _decode(encoded: str) -> str:
    if not encoded.startswith(_COMPACT):
        return unquote(encoded)
    compact = encoded.removeprefix(_COMPACT)
    return base64.urlsafe_b64decode(compact + "=" * (-len(compact) % 4)).decode()


def _unusable(path: str, error: OSError) -> StoreError:
    return StoreError(f"the blob {path} cannot be used: {error.strerror}. Check disk space and permissions.")

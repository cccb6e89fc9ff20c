"""A store of named byte sequences: Azure Blob Storage, S3 or files.

Names are non-empty Unicode text of at most 512 characters. ``/`` only groups names. Adapters encode characters that
their store does not accept.
"""

from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol
from urllib.parse import urlsplit

MAX_NAME_LENGTH = 512
MAX_BYTES = 64 * 1024 * 1024
"""Largest blob that passes through the functions [bytes]. Larger blobs are uploaded directly to the store."""


MAX_UPLOAD_BYTES = 4 * 1024**3
"""Largest direct upload in one request [bytes]. S3 accepts 5 GB, Azure slightly less."""


@dataclass(frozen=True, slots=True)
class Upload:
    """A single-use upload request: exactly these ``headers`` and a body of the agreed length."""

    method: str
    url: str
    headers: Mapping[str, str] = field(default_factory=dict)


class Blobs(Protocol):
    """Stores blobs. Every call is atomic: a reader gets the old content or the new content.

    Idempotent: ``put``, ``delete`` and the reading methods. ``append`` is not: a retry may append twice. When the store
    is not reachable, every method raises ``tables.StoreError``; the state of a failed write is unknown.

    All methods raise ``ValueError`` for an empty or too long name, and for a blob larger than ``MAX_BYTES``.

    Example::

        await blobs.put("drawings/ur5", content)
        assert await blobs.get("drawings/ur5") == content
    """

    @property
    def origin(self) -> str:
        """Origin of all presigned URLs, such as ``https://store.example``; empty if the functions serve them."""

    async def put(self, name: str, content: bytes) -> None:
        """Write a blob and replace earlier content."""

    async def get(self, name: str) -> bytes | None:
        """Read a blob, or ``None`` if it does not exist."""

    async def append(self, name: str, content: bytes) -> None:
        """Append bytes; the first call creates the blob. Concurrent appends do not interleave."""

    async def delete(self, name: str) -> None:
        """Delete a blob. No error if it does not exist."""

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        """At most ``limit`` names that start with ``prefix``, sorted."""

    async def size(self, name: str) -> int | None:
        """Size [bytes], or ``None`` if the blob does not exist."""

    async def presign_upload(self, name: str, *, length: int, content_type: str, lifetime_s: int) -> Upload:
        """A request that uploads a blob of ``length`` bytes directly to the store.

        It expires after ``lifetime_s`` [s] and never replaces an existing blob. Azure accepts other lengths too, so
        compare ``size`` before you use the blob.

        Raises:
            ValueError: ``length`` is not 0…``MAX_UPLOAD_BYTES``.
        """

    async def presign_download(self, name: str, *, content_type: str, lifetime_s: int) -> str:
        """A URL to download the blob for ``lifetime_s`` [s]; a browser saves the content and does not run it."""

    async def close(self) -> None:
        """Close all connections."""


class TransferRefused(Exception):  # noqa: N818 (the caller answers the request with it)
    """A presigned URL is not valid for this request; ``status`` is the HTTP status."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True, slots=True)
class Download:
    """The content of a presigned download."""

    content: AsyncGenerator[bytes, None]
    length: int
    content_type: str


class Transfers(Protocol):
    """Serves presigned URLs, for a store without an HTTP interface of its own."""

    async def receive(self, token: str, headers: Mapping[str, str], content: AsyncIterator[bytes]) -> None:
        """Store an upload as a stream, without holding it in memory.

        Raises:
            TransferRefused: The token is not ours or expired, length or type differ, or the blob exists already.
            StoreError: The store is not available.
        """

    async def send(self, token: str) -> Download:
        """The content that a download URL refers to.

        Raises:
            TransferRefused: The token is not ours or expired, or the blob does not exist.
            StoreError: The store is not available.
        """


def origin_of(url: str) -> str:
    """The origin of a URL; empty if it has no host."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc}" if parts.netloc else ""


def check_upload(length: int) -> None:
    """Check the length of an upload.

    Raises:
        ValueError: No store accepts an upload of this length in one request.
    """
    if not 0 <= length <= MAX_UPLOAD_BYTES:
        raise ValueError(f"an upload has 0 to {MAX_UPLOAD_BYTES} bytes, not {length}")


def check_name(name: str) -> None:
    """Check the name of a blob.

    Raises:
        ValueError: It is empty, too long, or no Unicode text.
    """
    if not 1 <= len(name) <= MAX_NAME_LENGTH:
        raise ValueError(f"a blob's name has 1 to {MAX_NAME_LENGTH} characters, not {len(name)}")
    try:
        name.encode()
    except UnicodeEncodeError as error:
        raise ValueError("a blob's name is Unicode text without lone surrogates") from error


def check_size(size: int) -> None:
    """Check the size of a blob [bytes].

    Raises:
        ValueError: It is larger than ``MAX_BYTES``.
    """
    if size > MAX_BYTES:
        raise ValueError(f"a blob holds at most {MAX_BYTES} bytes, not {size}")

"""Bytes under a name. Azure Blob, S3, files.

Names are non-empty Unicode text up to 512 characters; ``/`` only groups, adapters encode what their store cannot take.
"""

from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

MAX_NAME_LENGTH = 512
MAX_BYTES = 64 * 1024 * 1024
"""Most that passes through the functions; what is larger goes straight to the store."""


MAX_UPLOAD_BYTES = 4 * 1024**3
"""Most that goes straight to the store in one request: S3 takes 5 GB, Azure a little less."""


@dataclass(frozen=True, slots=True)
class Upload:
    """A request that whoever has it may make once: exactly these ``headers`` and a body of the length agreed upon."""

    method: str
    url: str
    headers: Mapping[str, str] = field(default_factory=dict)


class Blobs(Protocol):
    """A store of blobs. Every call is atomic: a reader sees the old content or the new, never half.

    All methods raise ``tables.StoreError`` when the store cannot be used, and ``ValueError`` for an empty or too long
    name, or where a blob would have more than ``MAX_BYTES``.
    """

    async def put(self, name: str, content: bytes) -> None:
        """Write, over what was there."""

    async def get(self, name: str) -> bytes | None:
        """Read, or ``None`` when there is none."""

    async def append(self, name: str, content: bytes) -> None:
        """Add at the end; the first append creates. Parallel appends do not mix, their order is not promised."""

    async def delete(self, name: str) -> None:
        """Delete; nothing happens when there is none."""

    async def list(self, prefix: str, *, limit: int = 1000) -> tuple[str, ...]:
        """Names that start with ``prefix``, sorted, at most ``limit``."""

    async def size(self, name: str) -> int | None:
        """How many bytes there are, or ``None`` when there is no such blob."""

    async def presign_upload(self, name: str, *, length: int, content_type: str, lifetime_s: int) -> Upload:
        """A request that puts a blob of ``length`` bytes straight into the store, past the functions.

        It ends with ``lifetime_s`` [s] and never writes over what is there. Azure takes another length as well: who
        asked for it compares ``size`` before anybody relies on the blob.

        Raises:
            ValueError: ``length`` is not 0…``MAX_UPLOAD_BYTES``.
        """

    async def presign_download(self, name: str, *, content_type: str, lifetime_s: int) -> str:
        """An address from which the blob can be read for ``lifetime_s`` [s]; a browser saves rather than runs it."""

    async def close(self) -> None:
        """Let go of connections."""


class TransferRefused(Exception):  # noqa: N818 (an answer to whoever tries)
    """An address is not, or no longer, good for what is tried; ``status`` is HTTP's word for it."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True, slots=True)
class Download:
    """A blob on its way out."""

    content: AsyncIterator[bytes]
    length: int
    content_type: str


class Transfers(Protocol):
    """The other end of presigned addresses, where it is the functions' own: of a store that has no HTTP itself."""

    async def receive(self, token: str, headers: Mapping[str, str], content: AsyncIterator[bytes]) -> None:
        """Take an upload in, however large, without holding it in memory.

        Raises:
            TransferRefused: Not signed by us, over, another length or type, or there is such a blob already.
            StoreError: The store cannot be used.
        """

    async def send(self, token: str) -> Download:
        """What an address of a download leads to.

        Raises:
            TransferRefused: Not signed by us, over, or there is no such blob.
            StoreError: The store cannot be used.
        """


def check_upload(length: int) -> None:
    """Refuse what no store takes in one request.

    Raises:
        ValueError: It is so.
    """
    if not 0 <= length <= MAX_UPLOAD_BYTES:
        raise ValueError(f"an upload has 0 to {MAX_UPLOAD_BYTES} bytes, not {length}")

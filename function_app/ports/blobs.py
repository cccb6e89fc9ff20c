"""Bytes under a name. Azure Blob, S3, files.

Names are non-empty Unicode text up to 512 characters; ``/`` only groups, adapters encode what their store cannot take.
"""

from typing import Protocol

MAX_NAME_LENGTH = 512
MAX_BYTES = 64 * 1024 * 1024
"""Most that passes through the functions; what is larger goes straight to the store."""


class Blobs(Protocol):
    """A store of blobs. Every call is atomic: a reader sees the old content or the new, never half.

    All methods raise ``tables.StoreError`` when the store cannot be used, and ``ValueError`` for an empty or too long
    name or content over ``MAX_BYTES``.
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

    async def close(self) -> None:
        """Let go of connections."""

"""Atomic file writes."""

import os
import secrets
from pathlib import Path


def write(path: Path, content: bytes, *, mode: int) -> None:
    """Replace a file atomically; no other permissions than ``mode`` ever apply.

    Raises:
        OSError: It cannot be written.
    """
    write_temporary(path, content, mode=mode).replace(path)


def write_temporary(path: Path, content: bytes, *, mode: int) -> Path:
    """Write the content for ``path`` to a temporary file next to it, synchronized to disk; returns its path.

    Raises:
        OSError: It cannot be written.
    """
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(8)}.new")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return temporary

"""Atomic file writes."""

import os
import secrets
from pathlib import Path


def write(path: Path, content: bytes, *, mode: int) -> None:
    """Write a file atomically, with exactly this mode, independent of the umask.

    Raises:
        OSError: The file cannot be written.
    """
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}.new")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        os.fchmod(descriptor, mode)
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)

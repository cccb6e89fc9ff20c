"""Files written whole or not at all."""

import os
import secrets
from pathlib import Path


def write(path: Path, content: bytes, *, mode: int) -> None:
    """Write a file, at no moment there in part and at no moment open to more than ``mode`` says.

    Raises:
        OSError: It cannot be written.
    """
    write_beside(path, content, mode=mode).replace(path)


def write_beside(path: Path, content: bytes, *, mode: int) -> Path:
    """What is to become ``path``, safe on the disk under a name of its own; gives that.

    Raises:
        OSError: It cannot be written.
    """
    beside = path.with_name(f"{path.name}.{secrets.token_hex(8)}.new")
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return beside

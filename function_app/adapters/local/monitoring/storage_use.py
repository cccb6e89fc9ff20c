"""Disk space that tables and blobs of this machine use."""

import contextlib
import os
import time
from pathlib import Path

_REFRESH_S = 300.0
"""Adding up the sizes of all blobs reads every folder, so it is done rarely."""


class StorageUse:
    """Sizes of the files of a local store."""

    def __init__(self, tables: Path, blobs: Path) -> None:
        self._tables = tables
        self._blobs = blobs
        self._blob_bytes = 0
        self._read_s = -_REFRESH_S

    def read(self) -> dict[str, int]:
        """Sizes of tables and blobs [bytes]; those of the blobs are up to five minutes old. Blocks."""
        if time.monotonic() - self._read_s >= _REFRESH_S:
            self._blob_bytes = _size(self._blobs)
            self._read_s = time.monotonic()
        files = self._tables.parent.glob(f"{self._tables.name}*")
        return {"tables": sum(file.stat().st_size for file in files), "blobs": self._blob_bytes}


def _size(folder: str | Path) -> int:
    """The sizes of all files below a folder. Keeps one entry at a time."""
    total = 0
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            with contextlib.suppress(OSError):  # deleted meanwhile
                is_folder = entry.is_dir(follow_symlinks=False)
                total += _size(entry.path) if is_folder else entry.stat(follow_symlinks=False).st_size
    return total

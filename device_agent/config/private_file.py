"""Atomic writes of files that only the agent's user may read."""

import os
import tempfile
from pathlib import Path

from device_agent.config.errors import ConfigError


def write(path: Path, content: bytes) -> None:
    """Replace a file atomically with mode 0600. Creates the folder with mode 0700.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}") from error

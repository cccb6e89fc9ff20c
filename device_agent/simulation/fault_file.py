"""A file of injected faults that is re-read when it changes."""

import logging
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import msgspec
from msgspec import Struct

from device_agent.protocol.errors import ProtocolError

T = TypeVar("T")
S = TypeVar("S", bound=Struct)
_log = logging.getLogger(__name__)


class FaultFile(Generic[T]):
    """The file. It may be missing, and may be created, changed or deleted at any time.

    Args:
        path: The file; ``None`` disables polling.
        read: Parses its text; receives an empty text when the file is missing.

    Attributes:
        version: Modification time and size of the content read last; zeros for a missing file.
    """

    def __init__(self, path: Path | None, read: Callable[[str], T]) -> None:
        self._path = path
        self._read = read
        self.version = (0, 0)

    def poll(self) -> T | None:
        """The parsed content if the file has changed, else ``None``. An invalid file is logged and ignored."""
        if self._path is None:
            return None
        try:
            stat = self._path.stat()
            version, text = (stat.st_mtime_ns, stat.st_size), ""
            if version != self.version:
                text = self._path.read_text(encoding="utf-8")
        except FileNotFoundError:
            version, text = (0, 0), ""
        except (OSError, UnicodeDecodeError) as error:
            _log.warning("%s: %s", self._path, error)
            return None
        if version == self.version:
            return None
        self.version = version
        try:
            return self._read(text)
        except ProtocolError as error:
            _log.warning("%s: %s", self._path, error)
            return None


def read(text: str, kind: type[S]) -> S:
    """Parse a fault file.

    Raises:
        ProtocolError: Not TOML, or a field is unknown or invalid; the message lists the valid fields.
    """
    try:
        return msgspec.convert(tomllib.loads(text), kind)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ProtocolError(f"{error}; valid fields: {', '.join(kind.__struct_fields__)}") from error

"""A file of faults for something simulated, looked at again and again: whoever may write there can make it ill."""

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
    """The file; it need not be there, and may come, change and go.

    Args:
        path: Where it may be; ``None``: nowhere.
        read: Makes something of its text, and of none where it is not there.

    Attributes:
        seen: Time and size of what was read last; zeros for none.
    """

    def __init__(self, path: Path | None, read: Callable[[str], T]) -> None:
        self._path = path
        self._read = read
        self.seen = (0, 0)

    def news(self) -> T | None:
        """What it says now, when that has changed; a wrong file changes nothing, and is logged."""
        if self._path is None:
            return None
        try:
            stat = self._path.stat()
            seen, text = (stat.st_mtime_ns, stat.st_size), ""
            if seen != self.seen:
                text = self._path.read_text(encoding="utf-8")
        except FileNotFoundError:
            seen, text = (0, 0), ""
        except (OSError, UnicodeDecodeError) as error:
            _log.warning("%s: %s", self._path, error)
            return None
        if seen == self.seen:
            return None
        self.seen = seen
        try:
            return self._read(text)
        except ProtocolError as error:
            _log.warning("%s: %s", self._path, error)
            return None


def read(text: str, kind: type[S]) -> S:
    """What a file's text says.

    Raises:
        ProtocolError: Not TOML, or a field is unknown or wrong; the text lists those there are.
    """
    try:
        return msgspec.convert(tomllib.loads(text), kind)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ProtocolError(f"{error}; there are: {', '.join(kind.__struct_fields__)}") from error

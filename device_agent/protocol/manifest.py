"""How the manifest of a folder is read: TOML of one type; what is wrong is one error that names file and field."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import msgspec

from device_agent.protocol.errors import ProtocolError

Manifest = TypeVar("Manifest", bound=msgspec.Struct)


def load(path: Path, parse: Callable[[str], Manifest], *, named: str) -> Manifest:
    """Read and check a manifest.

    Args:
        path: The file.
        parse: Reads and checks its text.
        named: The field that equals the folder's name.

    Raises:
        ProtocolError: Missing, not TOML, or a field is wrong; the text names file and field.
    """
    try:
        manifest = parse(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeError, ProtocolError) as error:
        raise ProtocolError(f"{path}: {error}") from error
    name, folder = getattr(manifest, named), path.parent.name
    if name != folder:
        raise ProtocolError(f"{path}: {named} '{name}' must equal the folder's name '{folder}'")
    return manifest


def convert(text: str, kind: type[Manifest]) -> Manifest:
    """The fields of a manifest from TOML text.

    Raises:
        ProtocolError: Not TOML, or a field is wrong.
    """
    import tomllib  # noqa: PLC0415 (15 ms of regular expressions, for who reads a manifest only)

    try:
        return msgspec.convert(tomllib.loads(text), kind, strict=False)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ProtocolError(str(error)) from error

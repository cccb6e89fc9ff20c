"""How the manifest of a folder is read: TOML of one type; what is wrong is one error that names file and field."""

import math
from collections.abc import Callable, Collection, Sequence
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


def check_positive(what: str, value: float) -> None:
    """Refuse what is not above 0 and finite.

    Raises:
        ProtocolError: It is not.
    """
    if not 0 < value < math.inf:
        raise ProtocolError(f"{what} is {value}; it must be above 0 and finite")


def check_box(where: str, lower_m: Sequence[float], upper_m: Sequence[float]) -> None:
    """Refuse a box without an inside.

    Raises:
        ProtocolError: A corner is not finite, or the lower one is not below the upper one.
    """
    for lower, upper in zip(lower_m, upper_m, strict=True):
        if not -math.inf < lower < upper < math.inf:
            raise ProtocolError(f"{where}: lower_m must be below upper_m everywhere, and all of them finite")


def check_known(where: str, what: str, named: Sequence[str], known: Collection[str]) -> None:
    """Refuse a name that nothing has.

    Raises:
        ProtocolError: There is one; the text lists those there are.
    """
    for name in named:
        if name not in known:
            raise ProtocolError(f"{where}: no {what} '{name}'; there are: {', '.join(known)}")

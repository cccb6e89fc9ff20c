"""Reads TOML manifests; each error names the file and the field."""

import math
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec

from device_agent.protocol.errors import ProtocolError

Manifest = TypeVar("Manifest", bound=msgspec.Struct)


def load(path: Path, parse: Callable[[str], Manifest], *, named: str) -> Manifest:
    """Read and check a manifest, whose field ``named`` must equal the folder's name.

    Raises:
        ProtocolError: The file is missing, not TOML, or a field is wrong. The message names file and field.
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
    """Convert TOML text to a manifest.

    Raises:
        ProtocolError: The text is not TOML, or a field is wrong.
    """
    import tomllib  # noqa: PLC0415 (loading takes 15 ms, and only readers of manifests need it)

    try:
        return msgspec.convert(tomllib.loads(text), kind, strict=False)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ProtocolError(str(error)) from error


def check_positive(label: str, value: float) -> None:
    """Require a finite number above 0.

    Raises:
        ProtocolError: The number is not.
    """
    if not 0 < value < math.inf:
        raise ProtocolError(f"{label} is {value}; it must be above 0 and finite")


def check_box(where: str, lower_m: Sequence[float], upper_m: Sequence[float]) -> None:
    """Require finite corners with ``lower_m`` below ``upper_m`` on each axis.

    Raises:
        ProtocolError: The box is not valid.
    """
    for lower, upper in zip(lower_m, upper_m, strict=True):
        if not -math.inf < lower < upper < math.inf:
            raise ProtocolError(f"{where}: lower_m must be below upper_m everywhere, and all of them finite")


def check_known(where: str, label: str, named: Sequence[str], known: Collection[str]) -> None:
    """Require known names.

    Raises:
        ProtocolError: A name is unknown. The message lists the known names.
    """
    for name in named:
        if name not in known:
            raise ProtocolError(f"{where}: no {label} '{name}'; there are: {', '.join(known)}")

"""What a movement script may use, as a document: for editors, and for checks that run nothing.

``script_api.json`` is written by ``python -m device_agent.sandbox.api_document`` out of the code that scripts meet.
"""

from functools import cache
from pathlib import Path
from typing import Final, Literal

import msgspec
from msgspec import UNSET, Struct, UnsetType

DOCUMENT: Final = Path(__file__).with_name("script_api.json")
Names = Literal["joints", "frames", "postures", "expressions", "behaviours", "devices"]
"""What the strings of an argument are names of."""


class Parameter(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One parameter of a call. ``default`` is Python; without one it must be given."""

    name: str
    kind: Literal["positional", "keyword", "rest"]
    type: str = ""
    default: str | UnsetType = UNSET
    names: Names | UnsetType = UNSET


class Call(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A function or a method. ``doc`` is one line, ``details`` its whole docstring."""

    name: str
    signature: str
    doc: str
    details: str = ""
    parameters: tuple[Parameter, ...] = ()


class Value(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A name that is no function; ``attributes`` and ``methods`` where it has any."""

    name: str
    type: str
    doc: str
    attributes: tuple["Value", ...] = ()
    methods: tuple[Call, ...] = ()


class ScriptApi(Struct, frozen=True, kw_only=True):
    """Everything that a script finds beside Python's own names; ``modules`` is what it may import."""

    values: tuple[Value, ...]
    functions: tuple[Call, ...]
    modules: tuple[str, ...]


@cache
def script_api() -> ScriptApi:
    """The document."""
    return msgspec.json.decode(DOCUMENT.read_bytes(), type=ScriptApi)

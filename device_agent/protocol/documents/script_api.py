"""The API of movement scripts as a document, for editors and linters.

``python -m device_agent.sandbox.api_document`` generates ``script_api.json`` from the code that scripts use.
"""

from functools import cache
from pathlib import Path
from typing import Final, Literal

import msgspec
from msgspec import UNSET, Struct, UnsetType

DOCUMENT: Final = Path(__file__).with_name("script_api.json")
Names = Literal["joints", "frames", "postures", "expressions", "behaviours", "devices"]
"""Kind of names that a string argument takes."""


class Parameter(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One parameter of a call. ``default`` is Python source; a parameter without default is required."""

    name: str
    kind: Literal["positional", "keyword", "rest"]
    type: str = ""
    default: str | UnsetType = UNSET
    names: Names | UnsetType = UNSET


class Call(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A function or method. ``doc`` is the first line of its docstring, ``details`` the whole."""

    name: str
    signature: str
    doc: str
    details: str = ""
    parameters: tuple[Parameter, ...] = ()


class Value(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A name that is not a function, with its ``attributes`` and ``methods``."""

    name: str
    type: str
    doc: str
    attributes: tuple["Value", ...] = ()
    methods: tuple[Call, ...] = ()


class ScriptApi(Struct, frozen=True, kw_only=True):
    """All names available to a script besides Python's builtins; ``modules`` lists the importable modules."""

    values: tuple[Value, ...]
    functions: tuple[Call, ...]
    modules: tuple[str, ...]


@cache
def script_api() -> ScriptApi:
    """The shipped document."""
    return msgspec.json.decode(DOCUMENT.read_bytes(), type=ScriptApi)

"""What a script finds, as a document, made from the very objects that it is given.

``python -m device_agent.sandbox.api_document`` prints it; ``make contract`` keeps ``protocol/script_api.json`` equal to it.
"""

import inspect
import json
import re
import sys
from collections.abc import Callable
from typing import Any, Final

import msgspec

from device_agent.protocol.documents.script_api import Call, Names, Parameter, ScriptApi, Value
from device_agent.sandbox import api
from device_agent.sandbox.importable_modules import SHOWN

_TASK: Final[dict[str, Any]] = {"joints": (), "frames": (), "can": (), "parameters": {}}
_STRINGS: Final[dict[tuple[str, str], Names]] = {
    ("move_joints", "position_rad"): "joints",
    ("move_to", "frame"): "frames",
    ("stiffness", "joints"): "joints",
    ("express", "name"): "expressions",
    ("posture", "name"): "postures",
    ("behaviour", "name"): "behaviours",
    ("latest", "device"): "devices",
    ("taken", "device"): "devices",
}
"""Call and parameter → what its strings are names of."""
_PARAMETERS: Final = "What the operator set, by name: see `PARAMETERS` of this script."
_PRINT: Final = Call(
    name="print",
    signature="print(*values)",
    doc="Write to the operator's page.",
    parameters=(
        Parameter(name="values", kind="rest"),
        *(Parameter(name=name, kind="keyword", default="None") for name in ("sep", "end", "file", "flush")),
    ),
)
_KINDS: Final[dict[Any, str]] = {
    inspect.Parameter.POSITIONAL_OR_KEYWORD: "positional",
    inspect.Parameter.KEYWORD_ONLY: "keyword",
}


def document() -> ScriptApi:
    """The document.

    Raises:
        LookupError: ``_STRINGS`` names a parameter that there is not.
    """
    found = api.names(_nothing, _nothing, _nothing, _TASK)
    values, functions = [], [_PRINT]
    for name, given in found.items():
        if inspect.isfunction(given):
            functions.append(_call(name, given))
        elif inspect.isclass(given):
            values.append(Value(name=name, type="exception", doc=_first(given)))
        elif isinstance(given, dict):
            values.append(Value(name=name, type="dict[str, Any]", doc=_PARAMETERS))
        else:
            values.append(_object(name, given))
    known = {(each.name, one.name) for value in values for each in value.methods for one in each.parameters}
    if _STRINGS.keys() - known:
        raise LookupError(f"there is no {_STRINGS.keys() - known}")
    return ScriptApi(values=tuple(values), functions=tuple(functions), modules=tuple(SHOWN))


def _nothing(*_: Any, **__: Any) -> None:
    """Stands where a script would speak to its agent."""


def _object(name: str, given: object) -> Value:
    kind = type(given)
    text = inspect.getdoc(kind) or ""
    attributes = [
        Value(name=key, type="tuple[str, ...]", doc=_plain(doc))
        for key, doc in re.findall(r"^    (\w+): (.+)$", text, re.MULTILINE)
        if key in vars(given)
    ]
    methods = [
        _call(key, each) for key, each in vars(kind).items() if inspect.isfunction(each) and not key.startswith("_")
    ]
    return Value(name=name, type=kind.__name__, doc=_first(kind), attributes=tuple(attributes), methods=tuple(methods))


def _call(name: str, function: Callable[..., Any]) -> Call:
    signature = inspect.signature(function)
    parameters = [each for key, each in signature.parameters.items() if key != "self"]
    bare = signature.replace(
        parameters=[each.replace(annotation=inspect.Parameter.empty) for each in parameters],
        return_annotation=inspect.Signature.empty,
    )
    return Call(
        name=name,
        signature=f"{name}{bare}",
        doc=_first(function),
        details=_plain(inspect.getdoc(function) or ""),
        parameters=tuple(_parameter(name, each) for each in parameters),
    )


def _parameter(call: str, given: inspect.Parameter) -> Parameter:
    kind = inspect.formatannotation(given.annotation)
    found = {
        "name": given.name,
        "kind": _KINDS[given.kind],
        "type": re.sub(r"\b(?:typing|collections\.abc)\.", "", kind),
    }
    if given.default is not inspect.Parameter.empty:
        found["default"] = repr(given.default)
    if names := _STRINGS.get((call, given.name)):
        found["names"] = names
    return msgspec.convert(found, Parameter)


def _first(given: object) -> str:
    return _plain((inspect.getdoc(given) or "").partition("\n")[0])


def _plain(text: str) -> str:
    return text.replace("``", "`")


if __name__ == "__main__":
    json.dump(msgspec.to_builtins(document()), sys.stdout, indent=1, ensure_ascii=False)
    sys.stdout.write("\n")

"""Generates the script API document from the objects that scripts use.

``python -m device_agent.sandbox.api_document`` prints it; ``make contract`` updates ``script_api.json``.
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
from device_agent.sandbox.importable_modules import LISTED

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
"""Call and parameter → kind of names that its strings are."""
_PARAMETERS: Final = "Parameters that the operator set, by name; declared in `PARAMETERS`."
_PRINT: Final = Call(
    name="print",
    signature="print(*values)",
    doc="Print to the operator's console.",
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
    """The script API.

    Raises:
        LookupError: ``_STRINGS`` names an unknown parameter.
    """
    objects = api.namespace(_no_agent, _no_agent, _no_agent, _TASK)
    values, functions = [], [_PRINT]
    for name, value in objects.items():
        if inspect.isfunction(value):
            functions.append(_call(name, value))
        elif inspect.isclass(value):
            values.append(Value(name=name, type="exception", doc=_first(value)))
        elif isinstance(value, dict):
            values.append(Value(name=name, type="dict[str, Any]", doc=_PARAMETERS))
        else:
            values.append(_object(name, value))
    known = {
        (method.name, parameter.name) for value in values for method in value.methods for parameter in method.parameters
    }
    if _STRINGS.keys() - known:
        raise LookupError(f"unknown parameters: {_STRINGS.keys() - known}")
    return ScriptApi(values=tuple(values), functions=tuple(functions), modules=tuple(LISTED))


def _no_agent(*_: Any, **__: Any) -> None:
    """Placeholder for communication with the agent."""


def _object(name: str, value: object) -> Value:
    kind = type(value)
    text = inspect.getdoc(kind) or ""
    attributes = [
        Value(name=key, type="tuple[str, ...]", doc=_plain(doc))
        for key, doc in re.findall(r"^    (\w+): (.+)$", text, re.MULTILINE)
        if key in vars(value)
    ]
    methods = [
        _call(key, method)
        for key, method in vars(kind).items()
        if inspect.isfunction(method) and not key.startswith("_")
    ]
    return Value(name=name, type=kind.__name__, doc=_first(kind), attributes=tuple(attributes), methods=tuple(methods))


def _call(name: str, function: Callable[..., Any]) -> Call:
    signature = inspect.signature(function)
    parameters = [parameter for key, parameter in signature.parameters.items() if key != "self"]
    bare = signature.replace(
        parameters=[parameter.replace(annotation=inspect.Parameter.empty) for parameter in parameters],
        return_annotation=inspect.Signature.empty,
    )
    return Call(
        name=name,
        signature=f"{name}{bare}",
        doc=_first(function),
        details=_plain(inspect.getdoc(function) or ""),
        parameters=tuple(_parameter(name, parameter) for parameter in parameters),
    )


def _parameter(call: str, parameter: inspect.Parameter) -> Parameter:
    kind = inspect.formatannotation(parameter.annotation)
    fields = {
        "name": parameter.name,
        "kind": _KINDS[parameter.kind],
        "type": re.sub(r"\b(?:typing|collections\.abc)\.", "", kind),
    }
    if parameter.default is not inspect.Parameter.empty:
        fields["default"] = repr(parameter.default)
    if names := _STRINGS.get((call, parameter.name)):
        fields["names"] = names
    return msgspec.convert(fields, Parameter)


def _first(value: object) -> str:
    return _plain((inspect.getdoc(value) or "").partition("\n")[0])


def _plain(text: str) -> str:
    return text.replace("``", "`")


if __name__ == "__main__":
    json.dump(msgspec.to_builtins(document()), sys.stdout, indent=1, ensure_ascii=False)
    sys.stdout.write("\n")

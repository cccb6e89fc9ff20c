"""Static checks of movement scripts, without running them.

An ``error`` prevents saving; a ``warning`` would probably fail. Names computed at run time are not checked.
"""

import ast
import builtins
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from msgspec import UNSET

from device_agent.protocol.documents.script_api import Call, Value, script_api
from device_agent.protocol.manifests.robot_type import RobotType
from function_app.domain.common.problems import Problem
from function_app.services.robot_types.script_metadata import PARAMETERS, Script, read_script

MAX_MARKS: Final = 100
_GIVEN_BY_PYTHON: Final = frozenset(dir(builtins)) | {"__name__", "__builtins__"}
_ONE_OF: Final = {
    "joints": "joint",
    "frames": "frame",
    "postures": "posture",
    "expressions": "expression",
    "behaviours": "behaviour",
}


@dataclass(frozen=True, slots=True)
class LintMessage:
    """A message for a range: lines from 1, columns from 0 in characters."""

    severity: Literal["error", "warning"]
    message: str
    line: int = 1
    column: int = 0
    end_line: int = 1
    end_column: int = 0


@dataclass(frozen=True, slots=True)
class LintResult:
    """The result of a check; ``script`` is set if the script can be saved."""

    marks: tuple[LintMessage, ...]
    script: Script | None


def names_of(robot_type: RobotType) -> dict[str, tuple[str, ...]]:
    """Names that a robot type defines, grouped as in ``scripting.Names``."""
    return {
        "joints": tuple(joint.name for joint in robot_type.joints),
        "frames": robot_type.frames,
        "postures": tuple(robot_type.postures),
        "expressions": tuple(robot_type.expressions),
        "behaviours": tuple(robot_type.behaviours),
    }


def check_script(source: str, robot_type: RobotType) -> LintResult:
    """All messages for a script of this robot type."""
    try:
        script = read_script(source)
    except Problem as problem:
        return LintResult((_refusal(source, problem),), None)
    tree = ast.parse(source)
    result = sorted(_Reader(tree, names_of(robot_type)).marks(), key=lambda mark: (mark.line, mark.column))
    return LintResult(tuple(_in_characters(result[:MAX_MARKS], source)), script)


def _refusal(source: str, problem: Problem) -> LintMessage:
    """The place of an error that prevents saving."""
    try:
        tree = ast.parse(source)
    except SyntaxError as error:
        line, column = error.lineno or 1, max(0, (error.offset or 1) - 1)
        end_line, end_column = error.end_lineno or line, max(0, (error.end_offset or 0) - 1)
        if (end_line, end_column) <= (line, column):
            end_line, end_column = line, column + 1
        return LintMessage("error", f"{error.msg[:1].upper()}{error.msg[1:]}.", line, column, end_line, end_column)
    except (RecursionError, MemoryError, ValueError):
        return LintMessage("error", problem.detail)
    place = next((each for each in tree.body if PARAMETERS in _bound_by(each)), None)
    if place is None:
        return LintMessage("error", problem.detail)
    return next(_in_characters([_mark("error", place, problem.detail)], source))


class _Reader:
    """One pass over a script's syntax tree."""

    def __init__(self, tree: ast.Module, names: Mapping[str, Sequence[str]]) -> None:
        self._nodes = list(ast.walk(tree))
        self._names = names
        self._bound = {name for node in self._nodes for name in _bound_by(node)}
        api = script_api()
        self._modules = frozenset(api.modules)
        self._functions = {each.name: each for each in api.functions}
        self._values = {each.name: each for each in api.values}

    def marks(self) -> Iterator[LintMessage]:
        """All messages, unordered."""
        for node in self._nodes:
            match node:
                case ast.Import(names=names):
                    for alias in names:
                        yield from self._module(node, alias.name)
                case ast.ImportFrom(module=module, level=level):
                    yield from self._module(node, module or "" if level == 0 else "." * level + (module or ""))
                case ast.Name(id=name, ctx=ast.Load()):
                    yield from self._name(node, name)
                case ast.Attribute(value=ast.Name(id=owner), attr=attribute):
                    yield from self._attribute(node, owner, attribute)
                case ast.Call():
                    yield from self._call(node)

    def _module(self, node: ast.stmt, module: str) -> Iterator[LintMessage]:
        if module.partition(".")[0] not in self._modules:
            yield _mark("warning", node, f"A script cannot import '{module}'.")

    def _name(self, node: ast.Name, name: str) -> Iterator[LintMessage]:
        if not ({name} & (self._bound | _GIVEN_BY_PYTHON | self._functions.keys() | self._values.keys())):
            yield _mark("warning", node, f"There is no '{name}'.")

    def _attribute(self, node: ast.Attribute, owner: str, attribute: str) -> Iterator[LintMessage]:
        value = self._builtin(owner)
        if value is None or not value.methods or attribute.startswith("__"):
            return
        available = [*(each.name for each in value.methods), *(each.name for each in value.attributes)]
        if attribute not in available:
            yield _mark("warning", node, f"There is no {owner}.{attribute}; there are {', '.join(available)}.")

    def _builtin(self, name: str) -> Value | None:
        return None if name in self._bound else self._values.get(name)

    def _called(self, function: ast.expr) -> Call | None:
        match function:
            case ast.Name(id=name) if name not in self._bound:
                return self._functions.get(name)
            case ast.Attribute(value=ast.Name(id=owner), attr=name):
                value = self._builtin(owner)
                return next((each for each in value.methods if each.name == name), None) if value else None
        return None

    def _call(self, node: ast.Call) -> Iterator[LintMessage]:
        call = self._called(node.func)
        if call is None:
            return
        spread = any(isinstance(each, ast.Starred) for each in node.args) or any(not each.arg for each in node.keywords)
        if not spread:
            yield from _wrong_arguments(node, call)
        by_name = {each.name: each for each in call.parameters}
        in_order = [each for each in call.parameters if each.kind == "positional"]
        arguments = [*zip(in_order, node.args, strict=False)] if not spread else []
        arguments += [(by_name[each.arg], each.value) for each in node.keywords if each.arg in by_name]
        for parameter, value in arguments:
            if parameter.names is not UNSET:
                yield from self._strings(value, parameter.names)

    def _strings(self, value: ast.expr, kind: str) -> Iterator[LintMessage]:
        """Literal names that the robot type does not define; a type without a list accepts all names."""
        available = self._names.get(kind, ())
        for text in _texts(value) if available else ():
            name = str(text.value)
            if name and name not in available:
                message = f"This robot type has no {_ONE_OF[kind]} '{name}'; it has {', '.join(available)}."
                yield _mark("warning", text, message)


def _wrong_arguments(node: ast.Call, call: Call) -> Iterator[LintMessage]:
    if any(each.kind == "rest" for each in call.parameters):
        return
    order = [each.name for each in call.parameters if each.kind == "positional"]
    existing = [each.name for each in call.parameters]
    if len(node.args) > len(order):
        yield _mark("warning", node.args[len(order)], f"Too many arguments: {call.signature}.")
    arguments = {*order[: len(node.args)]}
    for each in node.keywords:
        if each.arg not in existing:
            yield _mark("warning", each, f"There is no argument '{each.arg}': {call.signature}.")
        elif each.arg in arguments:
            yield _mark("warning", each, f"'{each.arg}' is given twice.")
        arguments.add(str(each.arg))
    missing = [each.name for each in call.parameters if each.default is UNSET and each.name not in arguments]
    if missing:
        yield _mark("warning", node, f"Without {' and '.join(missing)}: {call.signature}.")


def _texts(value: ast.expr) -> Iterable[ast.Constant]:
    """The literals of a string, a list, or the keys of a dictionary."""
    match value:
        case ast.Constant(value=str()):
            return (value,)
        case ast.List(elts=parts) | ast.Tuple(elts=parts) | ast.Set(elts=parts) | ast.Dict(keys=parts):
            return [each for each in parts if isinstance(each, ast.Constant) and isinstance(each.value, str)]
    return ()


def _bound_by(node: ast.AST) -> set[str]:
    """All names that a node binds."""
    result: set[str] = set()
    match node:
        case (
            ast.Name(id=name, ctx=ast.Store() | ast.Del())
            | ast.AnnAssign(target=ast.Name(id=name))
            | ast.FunctionDef(name=name)
            | ast.AsyncFunctionDef(name=name)
            | ast.ClassDef(name=name)
            | ast.arg(arg=name)
            | ast.ExceptHandler(name=str(name))
            | ast.MatchAs(name=str(name))
            | ast.MatchStar(name=str(name))
            | ast.MatchMapping(rest=str(name))
        ):
            result = {name}
        case ast.Assign(targets=targets):
            result = {each.id for each in targets if isinstance(each, ast.Name)}
        case ast.Import(names=names) | ast.ImportFrom(names=names):
            result = {each.asname or each.name.partition(".")[0] for each in names}
        case ast.Global(names=several) | ast.Nonlocal(names=several):
            result = set(several)
    return result


def _mark(severity: Literal["error", "warning"], node: ast.stmt | ast.expr | ast.keyword, message: str) -> LintMessage:
    line, column = node.lineno, node.col_offset
    return LintMessage(severity, message, line, column, node.end_lineno or line, node.end_col_offset or column + 1)


def _in_characters(marks: Iterable[LintMessage], source: str) -> Iterator[LintMessage]:
    """Convert a UTF-8 byte offset of the syntax tree to characters."""
    lines = re.split(r"\r\n|\r|\n", source)

    def characters(line: int, column: int) -> int:
        return len(lines[line - 1].encode()[:column].decode(errors="ignore")) if line <= len(lines) else 0

    for mark in marks:
        column, end_column = characters(mark.line, mark.column), characters(mark.end_line, mark.end_column)
        yield replace(mark, column=column, end_column=end_column)

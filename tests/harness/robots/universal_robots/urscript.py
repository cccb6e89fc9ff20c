"""Executes the subset of URScript that the driver's program uses, cycle by cycle.

The text that arrives at the controller is translated line by line to Python, which has the same expressions. So the
tests execute the program itself, including its watchdog.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

BLOCKING = ("servoj", "stopj", "sync")
"""Functions that take at least one cycle of the controller; a program yields what they return."""
_STATEMENT = re.compile(r"[\w\[\]]+ = .+|\w+\(.*\)")
_OPENING = re.compile(r"(def \w+\(\)|while .+|if .+):")
_MIDDLE = re.compile(r"(elif .+|else):")


class ScriptError(Exception):
    """The text is not a program of the supported subset."""


def load(text: str, functions: Mapping[str, Callable[..., Any]]) -> Iterator[tuple[str, Any]]:
    """A started program: yields ``(function, argument)`` of each blocking call.

    Raises:
        ScriptError: The program is incomplete or uses something else than the subset.
    """
    lines, depth = [], 0
    for number, line in enumerate(text.splitlines()):
        statement = line.strip()
        if statement == "end":
            depth -= 1
        elif _OPENING.fullmatch(statement):
            lines.append("    " * depth + statement)
            depth += 1
        elif _MIDDLE.fullmatch(statement):
            lines.append("    " * (depth - 1) + statement)
        elif _STATEMENT.fullmatch(statement):
            blocking = statement.split("(")[0] in BLOCKING
            lines.append("    " * depth + ("yield " if blocking else "") + statement)
        elif statement:
            raise ScriptError(f"line {number + 1}: {statement}")
    if depth or not lines or not lines[0].startswith("def "):
        raise ScriptError("a program starts with def and ends with end")
    scope: dict[str, Any] = {"__builtins__": {}, **functions}
    exec("\n".join(lines), scope)  # noqa: S102 (the tests' own program)
    program: Iterator[tuple[str, Any]] = scope[lines[0].split()[1].removesuffix("():")]()
    return program

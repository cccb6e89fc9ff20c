"""Text of movement scripts: size limits, description and parameter schema."""

import ast
import json
from dataclasses import dataclass
from typing import Any

import msgspec

from function_app.domain.common.problems import Problem, invalid
from function_app.services.robot_types import parameter_schema

MAX_SOURCE = 64_000
"""Maximum number of characters, as in a ``RunMovement`` command."""
MAX_SOURCE_BYTES = 96 * 1024
"""Maximum size as JSON [bytes]: with parameters and the rest of the command it stays below ``codec.MAX_BYTES``."""
PARAMETERS = "PARAMETERS"
_DESCRIPTION = 200


@dataclass(frozen=True, slots=True)
class Script:
    """Description (first docstring line) and parameter schema of a script."""

    description: str
    schema: dict[str, Any] | None


def read_script(source: str) -> Script:
    """Check that a script is Python and can be sent, without running it.

    ``PARAMETERS = {...}`` at the top level, a literal, defines the parameters: name → JSON Schema.

    Raises:
        Problem: ``movement-invalid``, with the line; ``schema-invalid``.
    """
    if not 1 <= len(source) <= MAX_SOURCE:
        raise _bad(f"A script has 1 to {MAX_SOURCE} characters, not {len(source)}.")
    try:
        size = len(msgspec.json.encode(source))
        if size > MAX_SOURCE_BYTES:
            raise _bad(f"Written as JSON a script has at most {MAX_SOURCE_BYTES} bytes, not {size}. Shorten it.")
        tree = ast.parse(source)
        docstring = ast.get_docstring(tree) or ""
        schema = _schema(tree)
    except SyntaxError as error:
        raise _bad(f"Line {error.lineno}: {error.msg}.", line=error.lineno) from error
    except (RecursionError, MemoryError, ValueError) as error:
        raise _bad("The script is nested too deeply, or is not text.") from error
    return Script(docstring.partition("\n")[0][:_DESCRIPTION], schema)


def _schema(tree: ast.Module) -> dict[str, Any] | None:
    for statement in tree.body:
        match statement:
            case ast.Assign(targets=[ast.Name(id="PARAMETERS")], value=value):
                return _literal(value)
            case ast.AnnAssign(target=ast.Name(id="PARAMETERS"), value=ast.expr() as value):
                return _literal(value)
    return None


def _literal(value: ast.expr) -> dict[str, Any]:
    try:
        result = json.loads(json.dumps(ast.literal_eval(value), allow_nan=False))
    except (ValueError, TypeError) as error:
        detail = f"Line {value.lineno}: {PARAMETERS} must be a literal dictionary without expressions."
        raise _bad(detail, line=value.lineno) from error
    if not isinstance(result, dict):
        raise _bad(f"Line {value.lineno}: {PARAMETERS} must be a dictionary: name → schema.", line=value.lineno)
    return parameter_schema.plain(parameter_schema.of_properties(result))


def _bad(detail: str, **extras: Any) -> Problem:
    return invalid(detail, code="movement-invalid", **extras)

"""``robot-types/{type}/scripting``."""

from typing import Annotated, Literal

from msgspec import Meta

from device_agent.protocol.documents.script_api import ScriptApi
from function_app.entrypoints.http.framework.schemas import Request, Response
from function_app.services.robot_types.parameter_schema import ObjectSchema


class ScriptingOut(Response, frozen=True, kw_only=True):
    """What a script finds, and ``names``: ``joints``, ``frames``, ``postures`` … → those of the robot type."""

    api: ScriptApi
    names: dict[str, tuple[str, ...]]


class ScriptCheckRequest(Request, frozen=True, kw_only=True):
    """A script as it stands."""

    source: Annotated[str, Meta(max_length=200_000)]


class ScriptDiagnosticOut(Response, frozen=True, kw_only=True):
    """What is wrong, and where: lines from 1, columns from 0, in characters (not bytes, not UTF-16).

    With an ``error`` it cannot be saved; with a ``warning`` it can, and would most likely fail at the robot.
    """

    severity: Literal["error", "warning"]
    message: str
    line: int
    column: int
    end_line: int
    end_column: int


class ScriptCheckOut(Response, frozen=True, kw_only=True):
    """``savable``: no error. What the script says about itself is known then."""

    diagnostics: tuple[ScriptDiagnosticOut, ...]
    savable: bool
    description: str
    parameters_schema: ObjectSchema | None

"""``robot-types/{type}/movements``."""

from typing import Annotated

from msgspec import Meta

from device_agent.protocol import Label
from function_app.entrypoints.http.framework.schemas import Moment, Request, Response
from function_app.services.robot_types.parameter_schema import ObjectSchema
from function_app.services.robot_types.script_metadata import MAX_SOURCE


class SignatureOut(Response, frozen=True, kw_only=True):
    """Ed25519 over ``telescope/v1/movement``, a line feed, and ``signed`` (UTF-8).

    ``signed`` is robot type, name, version and SHA-256, a line each. ``signature`` and ``public`` are base64url;
    ``key`` is the id under which agents know the public key (``GET /agents/enrollment``).
    """

    key: str
    public: str
    signed: str
    signature: str


class MovementOut(Response, frozen=True, kw_only=True):
    """One version of a movement. Without a ``parameters_schema`` a script takes whatever it is given."""

    name: str
    description: str
    version: int
    sha256: str
    updated_at: Moment
    built_in: bool
    parameters_schema: ObjectSchema | None


class MovementSource(MovementOut, frozen=True, kw_only=True):
    """One version of a movement, with its script."""

    source: str
    signature: SignatureOut


class MovementList(Response, frozen=True, kw_only=True):
    """Movements by name, or versions of one, newest first."""

    items: tuple[MovementOut, ...]
    cursor: str | None


class MovementRequest(Request, frozen=True, kw_only=True):
    """A script.

    Without a description the first line of its docstring serves; without a schema its ``PARAMETERS = {…}``: a literal,
    name → schema, where a parameter without a default must be given. ``based_on``: the version that it was made from, 0
    for none; 409 ``movement-changed`` where another is the newest now.
    """

    source: Annotated[str, Meta(min_length=1, max_length=MAX_SOURCE)]
    description: Label | None = None
    parameters_schema: ObjectSchema | None = None
    based_on: Annotated[int, Meta(ge=0, le=2**31)] | None = None

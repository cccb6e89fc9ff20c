"""Requests and responses of robot types, previews, movements and the script editor."""

from typing import Annotated, Literal

from msgspec import Meta, field

from device_agent.protocol import Body, Joint, Label, Stream
from device_agent.protocol.description import MimicJoint, PositionDependentLimit
from device_agent.protocol.documents.script_api import ScriptApi
from function_app.entrypoints.http.framework.schemas import Moment, Request, Response, WaitMs
from function_app.services.robot_types.package_reader import MAX_FILES, MAX_MANIFEST
from function_app.services.robot_types.parameter_schema import ObjectSchema
from function_app.services.robot_types.script_metadata import MAX_SOURCE

MAX_UPLOAD = 8_500_000
"""Bytes of a request that uploads a robot type: the files' 6 MB as base64, and the rest."""
State = Literal["checking", "ready", "rejected"]


class RobotTypeUploadOut(Response, frozen=True, kw_only=True):
    """The newest upload. ``errors`` are those of the manifest's check and MuJoCo's own; ``warnings`` refuse nothing."""

    version: int
    state: State
    errors: tuple[str, ...]
    warnings: tuple[str, ...]
    uploaded_at: Moment


class RobotTypeOut(Response, frozen=True, kw_only=True):
    """What every robot of one type has in common, in the version in use: the newest one that was found good.

    ``state`` is ``ready`` as soon as there is one; until then everything is of the newest upload. ``files``: name →
    bytes. ``actions``: the kinds of action that such a robot may be asked for; each says itself which it takes.
    """

    type: str
    label: str
    kind: str
    version: int
    description: str
    driver: str
    joints: tuple[Joint, ...]
    frames: tuple[str, ...]
    capabilities: tuple[str, ...]
    home_rad: dict[str, float]
    mimic_joints: tuple[MimicJoint, ...]
    position_dependent_limits: tuple[PositionDependentLimit, ...]
    postures: tuple[str, ...]
    expressions: tuple[str, ...]
    behaviours: tuple[str, ...]
    actions: tuple[str, ...]
    streams: tuple[Stream, ...]
    built_in: bool
    state: State
    files: dict[str, int]
    upload: RobotTypeUploadOut | None


class RobotTypeList(Response, frozen=True, kw_only=True):
    """Robot types by id."""

    items: tuple[RobotTypeOut, ...]
    cursor: str | None


class RobotTypeRequest(Request, frozen=True, kw_only=True):
    """``manifest`` is the text of a ``robot.toml``; ``files`` name → text of an ``.xml``, base64 of others.

    Waits at most ``wait_ms`` for the validation.
    """

    manifest: Annotated[str, Meta(min_length=1, max_length=MAX_MANIFEST)]
    files: Annotated[dict[str, str], Meta(min_length=1, max_length=MAX_FILES)]
    wait_ms: WaitMs = 10_000


class RobotTypeTwin(Response, frozen=True, kw_only=True):
    """The model as a page can draw it: ``device`` and ``bodies`` as in ``desc/twin``, here for every robot of a type.

    ``actuators`` are the model's, ``cameras`` those of its scene.
    """

    device: str
    bodies: tuple[Body, ...]
    actuators: tuple[str, ...]
    cameras: tuple[str, ...]


MAX_SCRIPTS = 20
"""Movements that can be looked at with a robot type."""


class RobotTypePreviewRequest(Request, frozen=True, kw_only=True):
    """An upload to preview. ``movements``: name → script; they are checked, not stored."""

    manifest: Annotated[str, Meta(min_length=1, max_length=MAX_MANIFEST)]
    files: Annotated[dict[str, str], Meta(min_length=1, max_length=MAX_FILES)]
    movements: Annotated[dict[str, str], Meta(max_length=MAX_SCRIPTS)] = field(default_factory=dict)
    wait_ms: WaitMs = 10_000


class RobotTypePreviewOut(Response, frozen=True, kw_only=True):
    """A validated upload that is not saved yet. Only its account sees it, and it expires.

    ``robot_type`` is the result of saving it; its ``upload`` contains the validation result.
    """

    id: str
    expires_at: Moment
    robot_type: RobotTypeOut


class SaveRobotTypePreviewRequest(Request, frozen=True, kw_only=True):
    """Waits at most ``wait_ms`` for the validation."""

    wait_ms: WaitMs = 10_000


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
    """One version of a movement. Without a ``parameters_schema`` a script accepts any parameters."""

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

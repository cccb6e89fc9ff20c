"""Requests and responses of robot types, previews, movements and the script editor."""

from typing import Annotated, ClassVar, Literal

from msgspec import Meta, field

from device_agent.protocol import Body, Joint, Label, Stream
from device_agent.protocol.description import MimicJoint, PositionDependentLimit
from device_agent.protocol.documents.script_api import ScriptApi
from function_app.entrypoints.http.framework.schemas import LabelledRequest, Moment, Request, Response, WaitMs
from function_app.services.robot_types.package_reader import MAX_FILES, MAX_MANIFEST
from function_app.services.robot_types.parameter_schema import ObjectSchema
from function_app.services.robot_types.script_metadata import MAX_SOURCE

MAX_UPLOAD = 8_500_000
"""Maximum size of an upload request [bytes]: 6 MB of files as base64, manifest and scripts."""
State = Literal["checking", "ready", "rejected"]


class RobotTypeUploadOut(Response, frozen=True, kw_only=True):
    """The newest upload. ``errors``: results of the manifest check and of MuJoCo. ``warnings`` never reject."""

    version: int
    state: State
    errors: tuple[str, ...]
    warnings: tuple[str, ...]
    uploaded_at: Moment


class RobotTypeOut(Response, frozen=True, kw_only=True):
    """The active version of a robot type: the newest valid one.

    ``state`` is ``ready`` if a valid version exists; otherwise all fields describe the newest upload. ``files``: name
    → size [bytes]. ``actions``: action kinds that the type supports; a device may support other kinds.
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
    """Robot types, by id."""

    items: tuple[RobotTypeOut, ...]
    cursor: str | None


class RobotTypeRequest(Request, frozen=True, kw_only=True):
    """A robot type. ``manifest``: text of ``robot.toml``. ``files``: name → text of an ``.xml`` file, else base64.

    The response waits for the validation, at most ``wait_ms``.
    """

    manifest: Annotated[str, Meta(min_length=1, max_length=MAX_MANIFEST)]
    files: Annotated[dict[str, str], Meta(min_length=1, max_length=MAX_FILES)]
    wait_ms: WaitMs = 10_000


class RobotTypePackageOut(Response, frozen=True, kw_only=True):
    """A robot type for an agent. ``files``: name → base64, with ``robot.toml``.

    ``statement``: signed envelope with agent, type, version and the SHA-256 of each file.
    """

    statement: str
    files: dict[str, str]


class RobotTypeTwin(Response, frozen=True, kw_only=True):
    """The geometry of a robot type. ``device`` and ``bodies`` have the same form as in the message ``desc/twin``.

    ``actuators``: names in the model. ``cameras``: names in its scene.
    """

    device: str
    bodies: tuple[Body, ...]
    actuators: tuple[str, ...]
    cameras: tuple[str, ...]


MAX_SCRIPTS = 20
"""Maximum number of movements in a preview."""


class RobotTypePreviewRequest(Request, frozen=True, kw_only=True):
    """A robot type to preview. ``movements``: name → script; scripts are checked but not stored."""

    manifest: Annotated[str, Meta(min_length=1, max_length=MAX_MANIFEST)]
    files: Annotated[dict[str, str], Meta(min_length=1, max_length=MAX_FILES)]
    movements: Annotated[dict[str, str], Meta(max_length=MAX_SCRIPTS)] = field(default_factory=dict)
    wait_ms: WaitMs = 10_000


class RobotTypePreviewOut(Response, frozen=True, kw_only=True):
    """An upload that is not saved. Only its account can access it.

    ``robot_type``: the robot type that saving would create; its ``upload`` contains the validation result.
    """

    id: str
    expires_at: Moment
    robot_type: RobotTypeOut


class SaveRobotTypePreviewRequest(Request, frozen=True, kw_only=True):
    """``wait_ms``: maximum time to wait for the validation."""

    wait_ms: WaitMs = 10_000


class SignatureOut(Response, frozen=True, kw_only=True):
    """An Ed25519 signature of ``telescope/v1/movement``, a line feed, and ``signed`` (UTF-8).

    ``signed``: robot type, name, version and SHA-256, one per line. ``signature`` and ``public``: base64url. ``key``:
    id of the public key, as in ``GET /agents/enrollment``.
    """

    key: str
    public: str
    signed: str
    signature: str


class MovementOut(Response, frozen=True, kw_only=True):
    """One version of a movement. ``parameters_schema`` null: the script accepts any parameters."""

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
    """Movements by name, or versions of one movement, newest first."""

    items: tuple[MovementOut, ...]
    cursor: str | None


class MovementRequest(LabelledRequest, frozen=True, kw_only=True):
    """A movement script.

    ``description``: default: first line of the script's docstring. ``parameters_schema``: default: its literal
    ``PARAMETERS = {…}``, name → schema; parameters without a default are required. ``based_on``: the edited version,
    0 for none; 409 ``movement-changed`` if it is not the newest.
    """

    labels: ClassVar = ("description",)
    source: Annotated[str, Meta(min_length=1, max_length=MAX_SOURCE)]
    description: Label | None = None
    parameters_schema: ObjectSchema | None = None
    based_on: Annotated[int, Meta(ge=0, le=2**31)] | None = None


class ScriptingOut(Response, frozen=True, kw_only=True):
    """The script API. ``names``: ``joints``, ``frames``, ``postures`` … → names that the robot type defines."""

    api: ScriptApi
    names: dict[str, tuple[str, ...]]


class ScriptCheckRequest(Request, frozen=True, kw_only=True):
    """A script to check."""

    source: Annotated[str, Meta(max_length=200_000)]


class ScriptDiagnosticOut(Response, frozen=True, kw_only=True):
    """A problem and its position: lines from 1, columns from 0, in Unicode characters.

    A script with an ``error`` cannot be saved. A script with a ``warning`` can be saved but probably fails.
    """

    severity: Literal["error", "warning"]
    message: str
    line: int
    column: int
    end_line: int
    end_column: int


class ScriptCheckOut(Response, frozen=True, kw_only=True):
    """The result of a check. ``savable``: no errors; only then description and schema are available."""

    diagnostics: tuple[ScriptDiagnosticOut, ...]
    savable: bool
    description: str
    parameters_schema: ObjectSchema | None

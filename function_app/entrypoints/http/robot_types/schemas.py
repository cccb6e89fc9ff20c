"""``robot-types``."""

from typing import Annotated, Literal

from msgspec import Meta, field

from device_agent.protocol import Body, Joint, Stream
from device_agent.protocol.description import MimicJoint, PositionDependentLimit
from function_app.entrypoints.http.framework.schemas import Moment, Request, Response, WaitMs
from function_app.services.robot_types.package_reader import MAX_FILES, MAX_MANIFEST

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

    Waits at most ``wait_ms`` for the verdict.
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
    """As to add a robot type. ``movements``: name → script; they are looked at, and not stored."""

    manifest: Annotated[str, Meta(min_length=1, max_length=MAX_MANIFEST)]
    files: Annotated[dict[str, str], Meta(min_length=1, max_length=MAX_FILES)]
    movements: Annotated[dict[str, str], Meta(max_length=MAX_SCRIPTS)] = field(default_factory=dict)
    wait_ms: WaitMs = 10_000


class RobotTypePreviewOut(Response, frozen=True, kw_only=True):
    """An upload that is looked at before it is saved; nobody else sees it, and it goes by itself.

    ``robot_type`` is as it would be; its ``upload`` says whether it is good.
    """

    id: str
    expires_at: Moment
    robot_type: RobotTypeOut


class SaveRobotTypePreviewRequest(Request, frozen=True, kw_only=True):
    """Waits at most ``wait_ms`` for the verdict."""

    wait_ms: WaitMs = 10_000

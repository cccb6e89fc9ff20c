"""Wire contract between operators, the cloud and agents: all messages, as strict ``msgspec`` structs.

``at_ms`` is the sender's wall clock [ms since 1970, UTC], for display and storage. ``tick_ms`` is the agent's monotonic
clock [ms]; safety checks read no other clock. Quaternions are (w, x, y, z). The package depends on msgspec,
cryptography and pyjwt only.
"""

from typing import Any

import msgspec

from device_agent.protocol.acks import Ack, AckStatus, Reason, Stored, TrialCause, TrialReport, Verdict
from device_agent.protocol.commands import (
    KINDS,
    LANGUAGE_PATTERN,
    MAX_SEED,
    SHIPPED,
    CancelAction,
    CaptureRaw,
    CollectData,
    Command,
    Drive,
    DriveTarget,
    Express,
    GoTo,
    GrantLease,
    JogTarget,
    JointTarget,
    LookAt,
    MoveJoints,
    MovePose,
    ReleaseLease,
    Request,
    RequestControl,
    ResetStop,
    RobotTask,
    RoomTask,
    RotateKey,
    RunBehaviour,
    RunMovement,
    RunTrial,
    Say,
    SetCameraConsent,
    SetControl,
    Setpoint,
    SetStiffness,
    Stop,
    StopDevice,
    TakePicture,
    TakePosture,
    Task,
    WithdrawRequest,
)
from device_agent.protocol.description import (
    BaseLimits,
    Body,
    CameraStream,
    Control,
    Description,
    Diagnostic,
    Geometry,
    InterlockDescription,
    Joint,
    Stream,
    Twin,
    TwinJoint,
)
from device_agent.protocol.events import Event
from device_agent.protocol.fields import FIELD_PATTERN, MAX_VALUES, Field, Id, Label, Pose, Quaternion, Text, Vector3
from device_agent.protocol.state import (
    ActionState,
    CameraConsent,
    Capabilities,
    Fault,
    LeaseState,
    Mode,
    OpenRequest,
    Presence,
    Restriction,
    State,
    StopLatch,
)
from device_agent.protocol.telemetry import (
    BodyJoint,
    JointTelemetry,
    LidarScan,
    Measurements,
    TrackedPeople,
    TrackedPerson,
)
from device_agent.protocol.versions import PROTOCOL, VersionRange, common_version, incompatibility

__all__ = [
    "FIELD_PATTERN", "KINDS", "LANGUAGE_PATTERN", "MAX_SEED", "MAX_VALUES", "PROTOCOL", "SHIPPED", "Ack",
    "AckStatus", "ActionState", "BaseLimits", "Body", "BodyJoint", "CameraConsent", "CameraStream", "CancelAction",
    "Capabilities", "CaptureRaw", "CollectData", "Command", "Control", "Description", "Diagnostic", "Drive",
    "DriveTarget", "Event", "Express", "Fault", "Field", "Geometry", "GoTo", "GrantLease", "Id",
    "InterlockDescription", "JogTarget", "Joint", "JointTarget", "JointTelemetry", "Label", "LeaseState",
    "LidarScan", "LookAt", "Measurements", "Mode", "MoveJoints", "MovePose", "OpenRequest", "Pose", "Presence",
    "Quaternion", "Reason", "ReleaseLease", "Request", "RequestControl", "ResetStop", "Restriction", "RobotTask",
    "RoomTask", "RotateKey", "RunBehaviour", "RunMovement", "RunTrial", "Say", "SetCameraConsent", "SetControl",
    "SetStiffness", "Setpoint", "State", "Stop", "StopDevice", "StopLatch", "Stored", "Stream", "TakePicture",
    "TakePosture", "Task", "Text", "TrackedPeople", "TrackedPerson", "TrialCause", "TrialReport", "Twin",
    "TwinJoint", "Vector3", "Verdict", "VersionRange", "WithdrawRequest", "common_version", "incompatibility",
    "schema_components",
]  # fmt: skip


def schema_components() -> tuple[dict[str, Any], dict[str, Any]]:
    """JSON Schema of every message: references by name, and definitions."""
    reports = (Presence, Description, Twin, State, JointTelemetry, Measurements, LidarScan, TrackedPeople, Event, Ack)
    kinds = (*reports, Stored, Command, Setpoint, Stop)
    references, definitions = msgspec.json.schema_components(kinds, ref_template="#/components/schemas/{name}")
    return dict(zip((kind.__name__ for kind in kinds), references, strict=True)), definitions

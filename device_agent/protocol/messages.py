"""The messages of the wire contract, one struct each: ``reports`` from an agent, ``orders`` to it.

Times: ``at_ms`` is the sender's wall clock [ms since 1970, UTC], to show and to store; ``tick_ms`` is the agent's
monotonic clock [ms], the only one that safety reads. Quaternions are (w, x, y, z).
"""

from typing import Any

import msgspec

from device_agent.protocol.fields import (
    FIELD_PATTERN,
    MAX_VALUES,
    Count,
    Field,
    Id,
    JointPositions,
    Label,
    Milliseconds,
    Pose,
    Quaternion,
    Text,
    Vector3,
)
from device_agent.protocol.orders import (
    SHIPPED,
    AskLease,
    CancelAction,
    Command,
    DropRequest,
    GrantLease,
    JointTarget,
    MoveJoints,
    ReleaseLease,
    Request,
    ResetStop,
    RunMovement,
    Setpoint,
    Stop,
    StopDevice,
)
from device_agent.protocol.reports import (
    TERMINAL,
    Ack,
    AckStatus,
    ActionState,
    Body,
    Description,
    Event,
    Fault,
    Geometry,
    InterlockRule,
    Joint,
    JointTelemetry,
    LeaseState,
    Measurements,
    Mode,
    OpenRequest,
    Presence,
    Reason,
    Restriction,
    State,
    StopLatch,
    Stream,
    Twin,
    TwinJoint,
)

__all__ = [
    "FIELD_PATTERN",
    "MAX_VALUES",
    "SHIPPED",
    "TERMINAL",
    "Ack",
    "AckStatus",
    "ActionState",
    "AskLease",
    "Body",
    "CancelAction",
    "Command",
    "Count",
    "Description",
    "DropRequest",
    "Event",
    "Fault",
    "Field",
    "Geometry",
    "GrantLease",
    "Id",
    "InterlockRule",
    "Joint",
    "JointPositions",
    "JointTarget",
    "JointTelemetry",
    "Label",
    "LeaseState",
    "Measurements",
    "Milliseconds",
    "Mode",
    "MoveJoints",
    "OpenRequest",
    "Pose",
    "Presence",
    "Quaternion",
    "Reason",
    "ReleaseLease",
    "Request",
    "ResetStop",
    "Restriction",
    "RunMovement",
    "Setpoint",
    "State",
    "Stop",
    "StopDevice",
    "StopLatch",
    "Stream",
    "Text",
    "Twin",
    "TwinJoint",
    "Vector3",
    "schema_components",
]


def schema_components() -> tuple[dict[str, Any], dict[str, Any]]:
    """JSON Schema of every message: ``(references by name, definitions)``, for the generated documents."""
    kinds = (Presence, Description, Twin, State, JointTelemetry, Measurements, Event, Ack, Command, Setpoint, Stop)
    references, definitions = msgspec.json.schema_components(kinds, ref_template="#/components/schemas/{name}")
    return dict(zip((kind.__name__ for kind in kinds), references, strict=True)), definitions

"""Field types of messages, manifests and script calls."""

from typing import Annotated

from msgspec import Meta

from device_agent.protocol.topics import ID_PATTERN

Id = Annotated[str, Meta(pattern=f"^{ID_PATTERN}$", description="letters, digits, _ and -, 1 to 64 of them")]
Text = Annotated[str, Meta(max_length=2000)]
Label = Annotated[str, Meta(max_length=200)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Milliseconds = Annotated[int, Meta(ge=0, le=2**53)]
FIELD_PATTERN = r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,79}"
Field = Annotated[
    str, Meta(pattern=f"^{FIELD_PATTERN}$", description="letters, digits, _, - and dots, 1 to 80 of them")
]
MAX_VALUES = 128
"""Maximum number of values in one ``Measurements`` message."""
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Pose = Annotated[
    tuple[float, float, float, float, float, float, float],
    Meta(description="position x, y, z [m] and quaternion w, x, y, z of a frame in the robot's base"),
]
JointPositions = Annotated[
    dict[str, float],
    Meta(min_length=1, max_length=128, description="joint name → position [rad]; other joints keep their target"),
]

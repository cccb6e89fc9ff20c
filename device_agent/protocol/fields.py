"""Field types of messages, manifests and script calls."""

import re
from typing import Annotated

from msgspec import Meta, UnsetType

from device_agent.protocol.topics import ID_PATTERN

Id = Annotated[str, Meta(pattern=f"^{ID_PATTERN}$", description="letters, digits, _ and -, 1 to 64 of them")]
Text = Annotated[str, Meta(max_length=2000)]
UNPRINTABLE = (
    r"\u0000-\u001f\u007f-\u009f\u00ad\u0600-\u0605\u061c\u06dd\u070f\u0890\u0891\u08e2\u180e\u200b-\u200f"
    r"\u2028-\u202e\u2060-\u2064\u2066-\u206f\ufeff\ufff9-\ufffb"
    "\U000110bd\U000110cd\U00013430-\U0001343f\U0001bca0-\U0001bca3\U0001d173-\U0001d17a\U000e0001\U000e0020-\U000e007f"
)
"""Characters that a label must not contain: Unicode categories Cc, Cf, Zl and Zp. They change how text is displayed."""
Label = Annotated[
    str, Meta(max_length=200, pattern=f"^[^{UNPRINTABLE}]*$", description="no control and format characters")
]
TraceParent = Annotated[
    str, Meta(description="the header `traceparent` of W3C Trace Context; receivers ignore an invalid one")
]
_TRACEPARENT = re.compile(r"00-(?!0{32})([0-9a-f]{32})-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")
_UNPRINTABLE = re.compile(f"[{UNPRINTABLE}]")
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


def printable(text: str) -> str:
    """The text with each control or format character replaced by U+FFFD, as a label requires."""
    return _UNPRINTABLE.sub("\ufffd", text)


def trace_id(traceparent: str | UnsetType) -> str:
    """The trace id in a ``traceparent``: 32 hexadecimal digits; empty for an invalid or missing one."""
    match = _TRACEPARENT.fullmatch(traceparent) if traceparent else None
    return "" if match is None else match[1]

"""Converts messages of devices to Foxglove's schemas. Pure functions.

Schemas: https://docs.foxglove.dev/docs/sdk/schemas. Positions are in rad or m, as in Telescope.
"""

from collections.abc import Sequence
from typing import Final

from foxglove.messages import (
    CompressedImage,
    FrameTransform,
    FrameTransforms,
    JointState,
    JointStates,
    Log,
    LogLevel,
    Quaternion,
    Timestamp,
    Vector3,
)

from device_agent.protocol import Description, Event, JointTelemetry
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.errors import ProtocolError

BASE: Final = "base"
"""Name of the frame of a robot's base, after the id of the device."""
_LEVELS: Final = {"info": LogLevel.Info, "warning": LogLevel.Warning, "error": LogLevel.Error}
_MS_PER_S: Final = 1000
_NS_PER_MS: Final = 1_000_000
_END_MS: Final = 2**32 * _MS_PER_S
"""First time that Foxglove cannot express [ms since 1970]: its seconds have 32 bits and no sign."""


def joint_states(description: Description, telemetry: JointTelemetry) -> JointStates:
    """Positions, velocities and efforts of all joints, with the names of the description.

    Raises:
        ProtocolError: Foxglove cannot express the time.
        ValueError: The number of positions is not that of the joints.
    """
    count = len(description.joints)
    velocities = _measured(telemetry.velocity_rad_s, count)
    efforts = _measured(telemetry.effort_nm, count)
    columns = zip(description.joints, telemetry.position_rad, velocities, efforts, strict=True)
    return JointStates(
        timestamp=timestamp(telemetry.at_ms),
        joints=[
            JointState(name=joint.name, position=position, velocity=velocity, effort=effort)
            for joint, position, velocity, effort in columns
        ],
    )


def frame_transforms(device: str, description: Description, telemetry: JointTelemetry) -> FrameTransforms:
    """Poses of the robot's frames relative to its base.

    Raises:
        ProtocolError: Foxglove cannot express the time.
        ValueError: The number of poses is not that of the frames.
    """
    transforms = []
    for name, (x, y, z, qw, qx, qy, qz) in zip(description.frames, telemetry.frames, strict=True):
        transforms.append(
            FrameTransform(
                timestamp=timestamp(telemetry.at_ms),
                parent_frame_id=f"{device}/{BASE}",
                child_frame_id=f"{device}/{name}",
                translation=Vector3(x=x, y=y, z=z),
                rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
            )
        )
    return FrameTransforms(transforms=transforms)


def compressed_image(frame_id: str, frame: CameraFrame, at_ms: int) -> CompressedImage:
    """A JPEG image of a camera, taken at ``at_ms`` [ms since 1970].

    Raises:
        ProtocolError: Foxglove cannot express the time.
    """
    return CompressedImage(timestamp=timestamp(at_ms), frame_id=frame_id, data=frame.content, format="jpeg")


def log(device: str, event: Event) -> Log:
    """An event of a device as log message. Raises ``ProtocolError``: Foxglove cannot express the time."""
    return Log(
        timestamp=timestamp(event.at_ms),
        level=_LEVELS[event.severity],
        message=event.message,
        name=f"{device}/{event.kind}",
    )


def timestamp(at_ms: int) -> Timestamp:
    """A wall-clock time [ms since 1970].

    Raises:
        ProtocolError: The time is before 1970 or after 2106, which Foxglove cannot express.
    """
    if not 0 <= at_ms < _END_MS:
        raise ProtocolError(f"the time {at_ms} ms is before 1970 or after 2106")
    return Timestamp(sec=at_ms // _MS_PER_S, nsec=at_ms % _MS_PER_S * _NS_PER_MS)


def _measured(values: Sequence[float], count: int) -> Sequence[float | None]:
    """The values, or ``None`` for each joint of a robot that does not measure them."""
    return values if len(values) == count else [None] * count

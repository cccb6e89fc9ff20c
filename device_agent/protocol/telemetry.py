"""Measurement streams, and the contents of ``cam/{name}`` that are JSON. Readers ignore unknown fields."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.protocol.fields import MAX_VALUES, Count, Field, Label, Milliseconds, Pose, Vector3
from device_agent.protocol.state import Mode


class JointTelemetry(Struct, frozen=True, kw_only=True):
    """``tele/joints``: all joints of one device at one tick, in the order of ``Description.joints``.

    Attributes:
        epoch: Epoch of the lease in force at the device, 0 for none. A holder that reads 0 has lost control.
        setpoint_sequence: Newest setpoint that the control loop has accepted; 0 for none in this lease.
        setpoint_sent_ms: ``sent_ms`` of that setpoint, so that the operator measures its round trip on one clock.
        ended_input: Highest ``input`` of this lease whose setpoints the device no longer accepts; 0 for none.
        limited: Limits that changed a setpoint before it reached the motors.
    """

    tick_ms: Milliseconds
    at_ms: Milliseconds
    sequence: Count
    mode: Mode
    position_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    effort_nm: tuple[float, ...]
    commanded_rad: tuple[float, ...]
    frames: tuple[Pose, ...] = ()
    epoch: Count = 0
    setpoint_sequence: Count = 0
    setpoint_sent_ms: float = 0.0
    loop_age_ms: float = 0.0
    ended_input: Count = 0
    limited: tuple[Label, ...] = ()


class Measurements(Struct, frozen=True, kw_only=True):
    """``tele/{stream}`` except ``joints``: named values, all measured at one moment.

    A name consists of a quantity with its unit and, if the device has several, a dot and the part:
    ``temperature_c.elbow``. ``sequence`` starts anew with each start of the agent.
    """

    tick_ms: Milliseconds
    at_ms: Milliseconds
    sequence: Count
    values: Annotated[dict[Field, float | bool], Meta(min_length=1, max_length=MAX_VALUES)]


MAX_BEAMS = 2880
"""Maximum number of beams in one ``LidarScan``."""
MAX_PEOPLE = 16
"""Maximum number of people in one ``TrackedPeople``."""
Rotation = Annotated[
    tuple[Vector3, Vector3, Vector3], Meta(description="rows of the matrix whose columns are the axes in the room")
]


class LidarScan(Struct, frozen=True, kw_only=True):
    """A frame of the kind ``scan``: all beams of one revolution.

    Attributes:
        position_m: Position of the lidar in the room [m].
        rotation: Its axes in the room; beams lie in its x-y plane.
        angle_rad: Angle of each beam about the z axis from the x axis [rad].
        range_m: Range of each beam [m]; ``null`` without an echo.
        nearest_m: Minimum range [m].
        furthest_m: Maximum range [m].
    """

    position_m: Vector3
    rotation: Rotation
    angle_rad: Annotated[tuple[float, ...], Meta(max_length=MAX_BEAMS)]
    range_m: Annotated[tuple[float | None, ...], Meta(max_length=MAX_BEAMS)]
    nearest_m: float
    furthest_m: float


class BodyJoint(Struct, frozen=True, kw_only=True):
    """One joint of a tracked person.

    Attributes:
        name: One of the 20 joints of Kinect v1, for example ``hand_left``; left and right are those of the person.
        position_m: Position in the room [m].
        state: ``tracked``: the sensor sees the joint. ``inferred``: it does not; the position is an estimate.
    """

    name: Label
    position_m: Vector3
    state: Literal["tracked", "inferred"]


class TrackedPerson(Struct, frozen=True, kw_only=True):
    """One tracked person.

    Attributes:
        id: Number that stays the same while the person is tracked.
        position_m: Centre of the body in the room [m].
        joints: Known joints; a joint without an estimate is missing.
    """

    id: Count
    position_m: Vector3
    joints: Annotated[tuple[BodyJoint, ...], Meta(max_length=64)] = ()


class TrackedPeople(Struct, frozen=True, kw_only=True):
    """A frame of the kind ``people``: all people that the sensor tracks now.

    Attributes:
        position_m: Position of the camera in the room [m].
        rotation: Its axes in the room: x to the right, y up, viewing direction -z.
        fovy_rad: Its vertical field of view [rad]; pixels are square.
        people: The tracked people.
    """

    position_m: Vector3
    rotation: Rotation
    fovy_rad: float
    people: Annotated[tuple[TrackedPerson, ...], Meta(max_length=MAX_PEOPLE)] = ()

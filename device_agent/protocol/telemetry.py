"""Measurement streams. Readers ignore unknown fields."""

from typing import Annotated

from msgspec import Meta, Struct

from device_agent.protocol.fields import MAX_VALUES, Count, Field, Label, Milliseconds, Pose
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

"""Tasks whose success is measured by sensors of the room, so that real robots can attempt them."""

import math
from typing import Annotated, Any

from msgspec import Meta, Struct

from device_agent.protocol import Field, Id, Label, Text
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import toml


class MeasuredSuccess(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Measurement that completes a task. Exactly one of ``above``, ``below`` and ``equals`` is given.

    Attributes:
        device: Name of a room device of the robot's agent, or id of any device of the space.
        stream: One of its streams.
        field: One of the values of that stream.
        above: The value is greater.
        below: The value is smaller.
        equals: The value is equal.
        rest_s: Time for which all measurements have met the condition without interruption [s].
        stale_s: Without a measurement for this time the condition is not met [s].
    """

    device: Id
    stream: Id
    field: Field
    above: float | None = None
    below: float | None = None
    equals: bool | float | None = None
    rest_s: float
    stale_s: Annotated[float, Meta(ge=0.1, le=60)] = 2.0

    @property
    def condition(self) -> str:
        """The condition as text, with the field."""
        if self.above is not None:
            return f"{self.field} > {self.above:g}"
        if self.below is not None:
            return f"{self.field} < {self.below:g}"
        return f"{self.field} = {str(self.equals).lower()}"

    def met_by(self, value: float | bool) -> bool:
        """Whether a value meets the condition."""
        if self.above is not None:
            return value > self.above
        if self.below is not None:
            return value < self.below
        return value == self.equals


class MeasuredTask(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Something that a robot shall do, as sensors of the room measure it.

    Attributes:
        name: Unique in the manifest.
        label: Display name.
        description: What the robot shall do, and what to prepare before a trial.
        movement: Movement of the robot type that attempts it.
        parameters: Parameters of the movement.
        time_limit_s: Longest duration of a trial [s].
        success: When it is complete.
    """

    name: Id
    label: Label
    description: Text
    movement: Id
    parameters: dict[str, Any] = {}
    time_limit_s: float
    success: MeasuredSuccess


def check_measured_task(task: MeasuredTask) -> None:
    """Check fields that depend on each other.

    Raises:
        ProtocolError: A field is wrong. The message names it.
    """
    where, success = f"task '{task.name}'", task.success
    conditions = [value for value in (success.above, success.below, success.equals) if value is not None]
    if len(conditions) != 1 or not math.isfinite(conditions[0]):
        raise ProtocolError(f"{where}: success needs exactly one of above, below and equals, with a finite number")
    toml.check_positive(f"{where}: time_limit_s", task.time_limit_s)
    toml.check_positive(f"{where}: success.rest_s", success.rest_s)

"""Digital outputs, tool inputs and the gripper of one arm: values that can be set, and streams."""

import time
from collections.abc import Mapping, Sequence

from device_agent.drivers.ur.connection import Connection, Measurement
from device_agent.drivers.ur.gripper import Gripper
from device_agent.ports.driver import DriverError
from device_agent.ports.skills import BehaviourContext, SkillError
from device_agent.protocol import Control

OUTPUTS: Mapping[str, tuple[str, int, int]] = {
    **{f"digital_{number}": ("standard", number, number) for number in range(8)},
    **{f"tool_{number}": ("tool", number, 16 + number) for number in range(2)},
}
"""Name → recipe, bit in the recipe, and bit in ``actual_digital_output_bits``. Source: *RTDE Guide*."""
IO, SETTINGS = "io", "settings"
"""Streams: inputs and outputs; values that can be set."""
GRIPPER = "gripper"
"""Control, and stream: how far it is closed and whether it holds an object."""
_CONFIRM_S = 1.0
_POLL_S = 0.01


class UrOutputs:
    """What operators may set at one arm.

    Args:
        names: Outputs that the owner permits, of ``OUTPUTS``.
        gripper: The gripper, if there is one.
    """

    def __init__(self, names: Sequence[str], gripper: Gripper | None) -> None:
        self._names = tuple(names)
        self._gripper = gripper
        self.banks = {OUTPUTS[name][0] for name in names}
        outputs = [Control(name=name, label=f"Output {name.replace('_', ' ')}", lower=0, upper=1) for name in names]
        fingers = [] if gripper is None else [Control(name=GRIPPER, label="Gripper closed", lower=0, upper=1)]
        self.controls = (*outputs, *fingers)

    def set(self, name: str, value: float, connection: Connection, context: BehaviourContext) -> float:
        """Set an output or the gripper; returns the measured value.

        Raises:
            SkillError: It is unknown, or the robot does not confirm it.
            DriverError: The controller is not connected.
        """
        if name == GRIPPER and self._gripper is not None:
            return self._gripper.move(value, context)
        if name not in self._names:
            raise SkillError(f"no output '{name[:80]}'; agent.toml permits: {', '.join(self._names) or 'none'}")
        bank, bit, measured_bit = OUTPUTS[name]
        on = round(value) << bit
        connection.set_output(bank, 1 << bit, on)
        end_s = time.monotonic() + _CONFIRM_S
        while bool(connection.measurement.outputs >> measured_bit & 1) != bool(on):
            if time.monotonic() > end_s:
                raise SkillError(f"the controller does not set '{name}'; is it controlled by a program or a URCap?")
            time.sleep(_POLL_S)
        return float(bool(on))

    def report(self, stream: str, newest: Measurement) -> Mapping[str, float | bool]:
        """Values of ``IO``, ``SETTINGS`` or ``GRIPPER``.

        Raises:
            DriverError: The gripper does not respond.
        """
        if stream == IO:
            values: dict[str, float | bool] = {}
            for name, (_, _, bit) in OUTPUTS.items():
                values[f"output.{name}"] = bool(newest.outputs >> bit & 1)
                values[f"input.{name}"] = bool(newest.inputs >> bit & 1)
            analog = {f"tool_analog.{number}": value for number, value in enumerate(newest.tool_analog)}
            return {**values, **analog, "tool_voltage_v": float(newest.tool_voltage_v)}
        try:
            if stream == GRIPPER:
                return {} if self._gripper is None else _state(self._gripper)
            settings: dict[str, float | bool] = {
                name: float(newest.outputs >> OUTPUTS[name][2] & 1) for name in self._names
            }
            closed = {} if self._gripper is None else {GRIPPER: round(self._gripper.closed(), 3)}
        except SkillError as error:
            raise DriverError(str(error)) from error
        return {**settings, **closed}


def _state(gripper: Gripper) -> Mapping[str, float | bool]:
    return {"closed": round(gripper.closed(), 3), "holds": gripper.holds()}

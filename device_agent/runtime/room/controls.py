"""Checks the value of a control against its limits."""

import math
from collections.abc import Sequence

from device_agent.protocol import Control
from device_agent.runtime.errors import Refused


def check_value(controls: Sequence[Control], name: str, value: float) -> None:
    """Check that a control exists and that the value is inside its limits.

    Raises:
        Refused: Unknown control, or value not finite or out of range; the text lists the names or the limits.
    """
    control = next((control for control in controls if control.name == name), None)
    if control is None:
        names = ", ".join(control.name for control in controls) or "none"
        raise Refused("unknown_control", f"no control '{name}'; there are: {names}")
    if not math.isfinite(value):
        raise Refused("not_finite", f"{name} must be a finite number")
    if not control.lower <= value <= control.upper:
        limits = f"{control.lower:g} to {control.upper:g} {control.unit}".rstrip()
        raise Refused("out_of_range", f"{name} can be {limits}, not {value:g}")

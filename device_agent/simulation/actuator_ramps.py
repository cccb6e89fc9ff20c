"""Linear interpolation from each driver's last actuator command to its newest one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from device_agent.simulation.scene_assembly import TIMESTEP_S
from device_agent.simulation.snapshot import Floats, Ints


@dataclass(frozen=True, slots=True)
class _Command:
    """A target [rad or m] for some actuators, reached linearly within ``ramp_s``."""

    actuators: Ints
    target: Floats
    ramp_s: float


@dataclass(slots=True)
class _Ramp:
    command: _Command
    remaining_s: float


class ActuatorRamps:
    """The newest command of each driver. Any thread submits commands; the world's thread follows them."""

    def __init__(self) -> None:
        self._commands: dict[str, _Command] = {}
        self._ramps: dict[str, _Ramp] = {}

    def command(self, driver: str, actuators: Ints, target: Sequence[float] | Floats, ramp_s: float) -> None:
        """Replace the driver's target. Never blocks."""
        self._commands[driver] = _Command(actuators, np.array(target, dtype=np.float64), ramp_s)

    def clear(self) -> None:
        """Discard all commands."""
        self._commands.clear()
        self._ramps.clear()

    def targets(self, ctrl: Floats) -> Floats:
        """Final target of each actuator, shape (nu,); the current control where there is no command."""
        target: Floats = ctrl.copy()
        for command in list(self._commands.values()):
            target[command.actuators] = command.target
        return target

    def update(self, ctrl: Floats) -> list[_Ramp]:
        """Start ramps for new commands; return the unfinished ramps."""
        for driver, command in list(self._commands.items()):
            ramp = self._ramps.get(driver)
            if ramp is None or ramp.command is not command:
                reached = np.array_equal(ctrl[command.actuators], command.target)
                self._ramps[driver] = _Ramp(command, 0.0 if reached else max(command.ramp_s, TIMESTEP_S))
        return [ramp for ramp in self._ramps.values() if ramp.remaining_s > 0]


def control_rows(ramps: Sequence[_Ramp], ctrl: Floats, count: int) -> Floats:
    """Follow the ramps for some steps.

    Args:
        ramps: Advanced in place.
        ctrl: Current controls, shape (nu,).
        count: Number of steps.

    Returns:
        The controls of each step, shape (count, nu).
    """
    rows = np.tile(ctrl, (count, 1))
    for index in range(count):
        if index:
            rows[index] = rows[index - 1]
        for ramp in ramps:
            _follow(ramp, rows[index])
    return rows


def _follow(ramp: _Ramp, ctrl: Floats) -> None:
    if ramp.remaining_s <= 0:
        return
    command = ramp.command
    share = min(1.0, TIMESTEP_S / ramp.remaining_s)
    now = ctrl[command.actuators]
    ctrl[command.actuators] = command.target if share > 1 - 1e-9 else now + (command.target - now) * share
    ramp.remaining_s = 0.0 if share > 1 - 1e-9 else ramp.remaining_s - TIMESTEP_S

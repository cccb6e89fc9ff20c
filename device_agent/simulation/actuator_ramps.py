"""The newest command of each driver of a world, and how its actuators go there: in a straight line, without a jump."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from device_agent.simulation.scene_assembly import TIMESTEP_S
from device_agent.simulation.snapshot import Floats, Ints


@dataclass(frozen=True, slots=True)
class _Command:
    """A target [rad or m] for some actuators, to be reached in a straight line within ``ramp_s``."""

    actuators: Ints
    target: Floats
    ramp_s: float


@dataclass(slots=True)
class _Ramp:
    command: _Command
    remaining_s: float


class Ramps:
    """Handed in by any thread, followed by the world's."""

    def __init__(self) -> None:
        self._commands: dict[str, _Command] = {}
        self._ramps: dict[str, _Ramp] = {}

    def command(self, who: str, actuators: Ints, target: Sequence[float] | Floats, ramp_s: float) -> None:
        """Put the newest target of one driver in the place of its last. Never blocks."""
        self._commands[who] = _Command(actuators, np.array(target, dtype=np.float64), ramp_s)

    def clear(self) -> None:
        """Forget all of them."""
        self._commands.clear()
        self._ramps.clear()

    def targets(self, ctrl: Floats) -> Floats:
        """Where each actuator shall go in the end; without a command where it is, shape (nu,)."""
        target: Floats = ctrl.copy()
        for command in list(self._commands.values()):
            target[command.actuators] = command.target
        return target

    def take(self, ctrl: Floats) -> list[_Ramp]:
        """Begin with what is new; those that are not there yet."""
        for who, command in list(self._commands.items()):
            ramp = self._ramps.get(who)
            if ramp is None or ramp.command is not command:
                there = np.array_equal(ctrl[command.actuators], command.target)
                self._ramps[who] = _Ramp(command, 0.0 if there else max(command.ramp_s, TIMESTEP_S))
        return [ramp for ramp in self._ramps.values() if ramp.remaining_s > 0]


def controls(ramps: Sequence[_Ramp], ctrl: Floats, count: int) -> Floats:
    """Follow the ramps for some steps.

    Args:
        ramps: They know then that they have been followed.
        ctrl: The controls of now, shape (nu,).
        count: Of the steps.

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

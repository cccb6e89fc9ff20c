"""Port: simulated room that several devices of one process share.

Drivers move robots in it, sensors observe it, and processes (a pedestrian, air temperature) advance it. It has one
thread, which is the only writer of its state.
"""

from collections.abc import Mapping
from typing import Any, Protocol


class Process(Protocol):
    """A process that advances with the simulation."""

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Advance to ``time_s``. Called in the world's thread before each group of steps (4 ms); must be fast.

        It may write mocap poses, and controls, positions and external forces of its own actuators, joints and bodies
        in ``data``, an ``MjData``. In the ``MjModel`` only colours and lights may change. ``time_s`` is simulated [s].
        """


class SimulatedWorld(Protocol):
    """Access of a room device to its world. Thread-safe."""

    @property
    def model(self) -> Any:
        """The compiled ``MjModel``, after ``open``. Read-only."""

    @property
    def quantities(self) -> Mapping[str, float]:
        """Newest values of quantities outside of MuJoCo's state, by name (``temperature_c``)."""

    @property
    def settings(self) -> Mapping[str, float]:
        """Values that were ``set`` last, by name."""

    def open(self) -> None:
        """Join the world; the first call starts real time.

        Raises:
            DriverError: The model cannot be built.
        """

    def close(self) -> None:
        """Leave the world; one call for each ``open``."""

    def add(self, process: Process) -> None:
        """Add a process, from the next group of steps."""

    def copy(self, into: Any) -> None:
        """Copy positions, velocities, mocap poses, controls and time of one moment into the caller's ``MjData``.

        Computes poses of bodies, geoms, sites, cameras and lights, but no contacts and sensors. Does not delay the
        world's thread.
        """

    def set(self, name: str, value: float) -> float:
        """Set a value of the room: the position of the model's actuator of this name, and ``settings``.

        Args:
            name: Actuator of the room's model, or a setting of a process: ``lamp``, ``thermostat``.
            value: Finite value in the actuator's unit.

        Returns:
            The applied value, within the actuator's range.

        Raises:
            DriverError: The value is not finite.
        """

    def sound(self, name: str, level_db: float, *, for_s: float) -> None:
        """Emit a sound for simulated ``for_s`` [s]; ``level_db``: A-weighted level at a distance of one metre [dB]."""

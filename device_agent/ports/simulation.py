"""The simulated room that several devices of one process share. Real rooms have none.

Robots' drivers move in it, sensors look at it, and processes (a person who walks, air that warms) go on in it. It has
one thread, and nobody else writes to its state.
"""

from collections.abc import Mapping
from typing import Any, Protocol


class Process(Protocol):
    """Something that goes on in a simulated room by itself."""

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Go on until ``time_s``. Called in the world's thread before each group of steps (4 ms): be quick.

        May write mocap poses, and the controls, positions and outer forces of its own actuators, joints and bodies, and
        nothing else.

        Args:
            model: ``MjModel``; of it only colours and lights may change.
            data: ``MjData``.
            time_s: Simulated time [s].
        """


class SimulatedWorld(Protocol):
    """What a room device may ask of the world it is in. Thread-safe."""

    @property
    def model(self) -> Any:
        """The compiled ``MjModel``, after ``open``. Not to be written to."""

    @property
    def quantities(self) -> Mapping[str, float]:
        """What has no place in MuJoCo's state, the newest of each, by name, as ``temperature_c``."""

    @property
    def settings(self) -> Mapping[str, float]:
        """What was ``set`` last, by name."""

    def open(self) -> None:
        """Take part; the first to do so starts real time.

        Raises:
            DriverError: The model cannot be built.
        """

    def close(self) -> None:
        """Leave; one call for each ``open``."""

    def add(self, process: Process) -> None:
        """Have something go on in it, from the next group of steps."""

    def copy(self, into: Any) -> None:
        """The state as it is now, all of one moment: positions, velocities, mocap poses, controls, time.

        Poses of bodies, geoms, sites, cameras and lights are computed; contacts and sensors are not. Costs the world's
        thread nothing.

        Args:
            into: An ``MjData`` of ``model`` that belongs to the caller.
        """

    def set(self, name: str, value: float) -> float:
        """Set something of the room: the position of the model's own actuator of this name, and ``settings``.

        Args:
            name: Of an actuator of the room's model, or one that a process reads: ``lamp``, ``thermostat``.
            value: Finite, in the actuator's own unit.

        Returns:
            What was applied, after the actuator's own range.

        Raises:
            DriverError: Not finite.
        """

    def sound(self, name: str, level_db: float, *, for_s: float) -> None:
        """Let something be heard: a level a metre away, A-weighted [dB], from now on for some simulated time [s]."""

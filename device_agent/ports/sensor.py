"""Port: driver of one room device, a sensor or a settable device. The implementer's manual.

A room device has streams (named values), cameras (frames), captures (raw data for the blob store) and controls
(settable values). A driver raises ``SensorError`` with the known names if a name is unknown.
``docs/guides/add-a-sensor.md`` shows an example.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from device_agent.ports.clock import wall_ms
from device_agent.ports.simulation import SimulatedWorld

Floats = npt.NDArray[np.float64]
Depths = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Values = Mapping[str, float | bool]
"""Quantity with its unit → value, as ``Measurements`` carries them: ``temperature_c``, ``present``."""


class SensorError(Exception):
    """The device cannot execute the request, or does not respond. The message is shown to operators."""


@dataclass(frozen=True, slots=True)
class Capture:
    """Raw data as a file: a PNG, a scan in JSON.

    Attributes:
        media_type: ``image/png``, ``application/json``.
        content: The file.
    """

    media_type: str
    content: bytes


@dataclass(frozen=True, slots=True)
class Frame:
    """One camera frame.

    Attributes:
        width: Width [pixels].
        height: Height [pixels].
        content: The JPEG.
        taken_s: Time of exposure on ``time.monotonic()`` [s].
    """

    width: int
    height: int
    content: bytes
    taken_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """One lidar scan, for perception in the same process. The reader owns the arrays.

    Attributes:
        taken_s: Time of measurement on ``time.monotonic()`` [s].
        position_m: Position of the lidar in the room, shape (3,) [m].
        rotation: Its axes in the room as columns, shape (3, 3); beams lie in its x-y plane.
        angle_rad: Angle of each beam about the z axis from the x axis, shape (n,) [rad].
        range_m: Measured range of each beam, shape (n,) [m]; ``inf`` for none within ``furthest_m``.
        nearest_m: Minimum range [m].
        furthest_m: Maximum range [m].
    """

    taken_s: float
    position_m: Floats
    rotation: Floats
    angle_rad: Floats
    range_m: Floats
    nearest_m: float
    furthest_m: float

    def capture(self) -> Capture:
        """The scan as a JSON file with the present time; ``null`` for a beam without an echo."""
        content = {
            "at_ms": wall_ms(),
            "position_m": [round(value, 4) for value in self.position_m.tolist()],
            "rotation": [[round(value, 6) for value in row] for row in self.rotation.tolist()],
            "angle_rad": [round(value, 6) for value in self.angle_rad.tolist()],
            "range_m": [round(value, 4) if math.isfinite(value) else None for value in self.range_m.tolist()],
            "nearest_m": self.nearest_m,
            "furthest_m": self.furthest_m,
        }
        return Capture("application/json", json.dumps(content).encode())


@dataclass(frozen=True, slots=True, kw_only=True)
class Image:
    """One image, for perception in the same process. The reader owns the arrays.

    Attributes:
        taken_s: Time of exposure on ``time.monotonic()`` [s].
        position_m: Position of the camera in the room, shape (3,) [m].
        rotation: Its axes in the room as columns, shape (3, 3): x to the right, y up, viewing direction -z.
        fovy_rad: Vertical field of view [rad]; pixels are square.
        rgb: Colours, shape (height, width, 3), top row first; ``None`` for a camera without colours.
        depth_m: Depth along the viewing direction, shape (height, width) [m]; ``inf`` out of range; ``None`` for a
            camera without depth.
    """

    taken_s: float
    position_m: Floats
    rotation: Floats
    fovy_rad: float
    rgb: Bytes | None = None
    depth_m: Depths | None = None


@runtime_checkable
class Reducible(Protocol):
    """A driver with work of its own that can run less often on an overloaded machine."""

    def reduce(self, share: float) -> None:
        """Run the work at this share of its rate, from 0 (excluded) to 1. Quick; called often."""


@runtime_checkable
class RoomDriver(Protocol):
    """Driver of one room device.

    The device's own thread calls ``connect``, ``read`` and ``frame``; the thread of the running action calls
    ``capture`` and ``set``; perception calls ``raw`` from its thread. Drivers synchronize where necessary. Calls may
    take as long as the sensor needs. The constructor accesses neither disk, network nor hardware.
    """

    @property
    def simulated(self) -> bool:
        """Whether the sensor is simulated. Known before ``connect``."""

    def connect(self) -> None:
        """Open the device. May be called again after a failure.

        Raises:
            SensorError: The device is missing or does not respond; the message names what to check.
        """

    def read(self, stream: str) -> Values:
        """The newest measurement of a stream; empty if there is none now.

        Raises:
            SensorError: The stream is unknown, or the device does not respond. The agent raises a fault and reconnects.
        """

    def capture(self, name: str) -> Capture:
        """Raw data, captured now.

        Raises:
            SensorError: The capture is unknown or failed.
        """

    def set(self, control: str, value: float) -> float:
        """Set a control; ``value`` is finite and within the manifest's limits.

        Returns:
            The applied value, after limits of the driver.

        Raises:
            SensorError: The control is unknown or failed.
        """

    def raw(self) -> Scan | Image | None:
        """The newest scan or image, at most 0.1 s old; ``None`` for other sensors.

        Raises:
            SensorError: The device does not respond.
        """

    def close(self) -> None:
        """Release the device. May be called repeatedly, and without ``connect``."""


@runtime_checkable
class Camera(RoomDriver, Protocol):
    """A room driver with camera streams for viewers, in addition to ``raw``."""

    def frame(self, camera: str) -> Frame | None:
        """A frame taken now, or ``None`` if there is none.

        Raises:
            SensorError: The camera is unknown or failed.
        """


@runtime_checkable
class Movable(RoomDriver, Protocol):
    """A room driver whose motion continues after ``set``: a door, blinds, a pan-tilt camera."""

    def hold(self) -> None:
        """Stop all motion. Fast; called at Stop, at a hold of the room and at a fault.

        Usually the device's own thread calls it; if that has ended or hangs, another one does.

        Raises:
            SensorError: The device failed.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """Environment of a room device's driver.

    Attributes:
        neighbours: Room drivers of the agent by device name; complete when ``connect`` is called.
        world: Simulated world of the room; ``None`` for a real room.
    """

    neighbours: Mapping[str, RoomDriver]
    world: SimulatedWorld | None = None

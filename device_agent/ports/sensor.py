"""Port: driver of one room device, a sensor or a settable device. The implementer's manual.

A room device has streams (named values), cameras (frames of several kinds), captures (raw data for the blob store) and
controls (settable values). A driver raises ``SensorError`` with the known names if a name is unknown.
``docs/guides/add-a-sensor.md`` shows an example.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np
import numpy.typing as npt

from device_agent.ports.clock import wall_ms
from device_agent.ports.simulation import SimulatedWorld
from device_agent.protocol import LidarScan, Vector3, camera_frames
from device_agent.protocol.telemetry import MAX_BEAMS

Floats = npt.NDArray[np.float64]
Depths = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Values = Mapping[str, float | bool]
"""Quantity with its unit → value, as ``Measurements`` carries them: ``temperature_c``, ``present``."""


def rounded(position_m: Floats) -> Vector3:
    """A position for messages, in steps of 0.1 mm."""
    x, y, z = (round(value, 4) for value in position_m.tolist())
    return x, y, z


def rounded_rows(rotation: Floats) -> tuple[Vector3, Vector3, Vector3]:
    """A rotation matrix of the shape (3, 3) for messages, row by row."""
    first, second, third = ((round(x, 6), round(y, 6), round(z, 6)) for x, y, z in rotation.tolist())
    return first, second, third


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
    """One frame for viewers; ``protocol.camera_frames`` describes the kinds and their contents.

    Attributes:
        width: Width: pixels, or the number of beams or people.
        height: Height [pixels]; 1 for other kinds than pictures.
        content: The content, for example a JPEG.
        taken_s: Time of the measurement on ``time.monotonic()`` [s].
        kind: Kind of the frame, as the manifest declares it for this camera.
    """

    width: int
    height: int
    content: bytes
    taken_s: float
    kind: str = camera_frames.COLOUR


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
        content = {"at_ms": wall_ms(), **msgspec.structs.asdict(self._message(every=1))}
        return Capture("application/json", msgspec.json.encode(content))

    def frame(self) -> Frame:
        """The scan for viewers. A scan with too many beams is reduced by a whole factor."""
        message = self._message(every=max(1, math.ceil(len(self.range_m) / MAX_BEAMS)))
        return Frame(len(message.range_m), 1, msgspec.json.encode(message), self.taken_s, camera_frames.SCAN)

    def _message(self, *, every: int) -> LidarScan:
        return LidarScan(
            position_m=rounded(self.position_m),
            rotation=rounded_rows(self.rotation),
            angle_rad=tuple(round(value, 6) for value in self.angle_rad[::every].tolist()),
            range_m=tuple(
                round(value, 4) if math.isfinite(value) else None for value in self.range_m[::every].tolist()
            ),
            nearest_m=self.nearest_m,
            furthest_m=self.furthest_m,
        )


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
    """A room driver with streams of frames for viewers, in addition to ``raw``."""

    def frame(self, camera: str) -> Frame | None:
        """A frame taken now, of the kind that the manifest declares, or ``None`` if there is none.

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

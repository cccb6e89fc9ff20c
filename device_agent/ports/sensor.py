"""What a driver does for one room device: a sensor, or a thing to set. This page is the implementer's manual.

A room device has streams (named values, read at a rate), cameras (pictures, read at a rate), captures (one raw
picture or scan, for the blob store) and controls (something to set). Each driver has some of them; asked for what it
has not, it raises ``SensorError`` and lists what there is. ``docs/guides/add-a-sensor.md`` makes one from nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from device_agent.ports.simulation import SimulatedWorld

Floats = npt.NDArray[np.float64]
Depths = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Values = Mapping[str, float | bool]
"""Quantity with its unit → value, as ``Measurements`` carries them: ``temperature_c``, ``present``."""


class SensorError(Exception):
    """The device cannot do what was asked, or no longer answers. Its text is fit for an operator."""


@dataclass(frozen=True, slots=True)
class Capture:
    """Something raw, as a file: a PNG, a scan in JSON.

    Attributes:
        media_type: ``image/png``, ``application/json``.
        content: The file.
    """

    media_type: str
    content: bytes


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture of a camera, as JPEG.

    Attributes:
        width: In pixels; ``height``: the same.
        content: The JPEG.
        taken_s: ``time.monotonic()`` when it was taken [s].
    """

    width: int
    height: int
    content: bytes
    taken_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """One turn of a lidar, for perception in the same process. Arrays are the reader's own.

    Attributes:
        taken_s: ``time.monotonic()`` when it was taken [s].
        position_m: Of the lidar in the room, shape (3,) [m].
        rotation: Its axes in the room as columns, shape (3, 3): beams lie in its x-y plane.
        angle_rad: Of each beam about its z axis from its x axis, shape (n,) [rad].
        range_m: To what each beam met, shape (n,) [m]; ``inf`` where it met nothing within ``furthest_m``.
        nearest_m: What is nearer is not seen [m].
        furthest_m: Nor what is further [m].
    """

    taken_s: float
    position_m: Floats
    rotation: Floats
    angle_rad: Floats
    range_m: Floats
    nearest_m: float
    furthest_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Image:
    """One picture, for perception in the same process. Arrays are the reader's own.

    Attributes:
        taken_s: ``time.monotonic()`` when it was taken [s].
        position_m: Of the camera in the room, shape (3,) [m].
        rotation: Its axes in the room as columns, shape (3, 3): x to the right of the picture, y up, and it looks
            along its negative z.
        fovy_rad: Angle of view from the lowest row to the highest [rad]; pixels are square.
        rgb: Colours, shape (height, width, 3), first row at the top; ``None`` for a camera that has none.
        depth_m: Distance along the line of sight's z, shape (height, width) [m]; ``inf`` where nothing is within reach;
            ``None`` for a camera that measures none.
    """

    taken_s: float
    position_m: Floats
    rotation: Floats
    fovy_rad: float
    rgb: Bytes | None = None
    depth_m: Depths | None = None


@runtime_checkable
class RoomDriver(Protocol):
    """Makes one room device measure and do what the agent asks.

    The device's own thread calls ``connect``, ``read`` and ``frame``; ``capture`` and ``set`` come from the thread of
    the action that runs, ``raw`` from whoever perceives: a driver locks where that matters. Each may take as long as
    its sensor needs; other devices do not wait for it. The constructor touches neither disk, network nor hardware.
    """

    @property
    def simulated(self) -> bool:
        """Whether it is no real sensor. Known before ``connect``."""

    def connect(self) -> None:
        """Open it. May be called again after it failed.

        Raises:
            SensorError: It is not there, or does not answer; the text says what to check.
        """

    def read(self, stream: str) -> Values:
        """The newest measurement of one of its streams. Empty where it has nothing to say at this moment.

        Raises:
            SensorError: No such stream; or it no longer answers. The agent then raises a fault and connects again.
        """

    def capture(self, name: str) -> Capture:
        """Something raw, taken now.

        Raises:
            SensorError: No such capture; or it failed.
        """

    def set(self, control: str, value: float) -> float:
        """Set one of its controls; ``value`` is finite and within the manifest's limits.

        Returns:
            What was really applied, after the driver's own clamping.

        Raises:
            SensorError: No such control; or it failed.
        """

    def raw(self) -> Scan | Image | None:
        """The newest scan or picture as arrays, at most a tenth of a second old; ``None`` where it takes none.

        Raises:
            SensorError: It no longer answers.
        """

    def close(self) -> None:
        """Let go. May be called twice, and without ``connect``."""


@runtime_checkable
class Camera(RoomDriver, Protocol):
    """A room driver with cameras: pictures for people, beside what ``raw`` gives."""

    def frame(self, camera: str) -> Frame | None:
        """A picture taken now; ``None`` where it has none at this moment.

        Raises:
            SensorError: No such camera; or it failed.
        """


@runtime_checkable
class Movable(RoomDriver, Protocol):
    """A room driver with something that goes on moving after ``set``: a door, blinds, a camera that turns."""

    def hold(self) -> None:
        """What moves stays where it is. Quick: called at Stop, at a hold of the room's and at a fault.

        Raises:
            SensorError: It failed.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """What the driver of a room device may reach besides its own hardware.

    Attributes:
        neighbours: The agent's other room drivers by the device's name. Complete when ``connect`` is called; before
            that it is still being filled.
        world: The simulated world of the device's room; ``None`` where the room is real.
    """

    neighbours: Mapping[str, RoomDriver]
    world: SimulatedWorld | None = None

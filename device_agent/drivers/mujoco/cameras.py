"""Cameras of a simulated robot: they are part of its model, and see the world that it is in."""

from collections.abc import Sequence
from typing import Any

import mujoco
import simplejpeg

from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Frame, SensorError
from device_agent.protocol import Stream
from device_agent.simulation.renderer import Renderer, studio_of
from device_agent.simulation.world import World

_WIDTH, _HEIGHT = 320, 240
_QUALITY = 75


class Eyes:
    """The cameras of one robot.

    Args:
        cameras: As its manifest names them, and its model.
        world: Where it is.
        prefix: Before its names in the world.
    """

    def __init__(self, cameras: Sequence[Stream], world: World, *, prefix: str) -> None:
        self._names = [camera.name for camera in cameras]
        self._world = world
        self._prefix = prefix
        self._cameras: dict[str, int] = {}
        self._studio: Renderer | None = None

    def open(self, model: Any) -> None:
        """Find them in the model.

        Raises:
            DriverError: One is not there.
        """
        found = {
            name: int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, self._prefix + name)) for name in self._names
        }
        for name, index in found.items():
            if index < 0:
                raise DriverError(f"the model has no camera '{self._prefix}{name}'")
        self._cameras = found
        if found:
            self._studio = studio_of(self._world)
            self._studio.open()

    def close(self) -> None:
        """Let go. May be called twice."""
        studio, self._studio = self._studio, None
        if studio is not None:
            studio.close()

    def frame(self, camera: str) -> Frame | None:
        """What it sees now; ``None`` while the robot is not connected.

        Raises:
            DriverError: No such camera, or nothing here can draw.
        """
        studio = self._studio
        if studio is None:
            return None
        if camera not in self._cameras:
            raise DriverError(f"no camera '{camera[:80]}'; there are: {', '.join(self._cameras)}")
        try:
            shot = studio.shoot(self._cameras[camera], width=_WIDTH, height=_HEIGHT)
        except SensorError as error:
            raise DriverError(str(error)) from error
        content = simplejpeg.encode_jpeg(shot.pixels, quality=_QUALITY, colorsubsampling="420")
        return Frame(_WIDTH, _HEIGHT, content, shot.taken_s)

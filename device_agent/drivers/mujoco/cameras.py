"""Cameras that are part of a simulated robot's model."""

from collections.abc import Sequence
from typing import Any

import mujoco
import simplejpeg

from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Frame, SensorError
from device_agent.protocol import Stream
from device_agent.simulation.renderer import Renderer, renderer_of
from device_agent.simulation.world import World

_WIDTH, _HEIGHT = 320, 240
_QUALITY = 75


class RobotCameras:
    """The cameras of one robot.

    Args:
        cameras: Camera streams of the manifest.
        world: The robot's world.
        prefix: Prefix of the robot's names in the world.
    """

    def __init__(self, cameras: Sequence[Stream], world: World, *, prefix: str) -> None:
        self._names = [camera.name for camera in cameras]
        self._world = world
        self._prefix = prefix
        self._cameras: dict[str, int] = {}
        self._renderer: Renderer | None = None

    def open(self, model: Any) -> None:
        """Find the cameras in the model.

        Raises:
            DriverError: A camera is missing.
        """
        indices = {
            name: int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, self._prefix + name)) for name in self._names
        }
        for name, index in indices.items():
            if index < 0:
                raise DriverError(f"the model has no camera '{self._prefix}{name}'")
        self._cameras = indices
        if indices:
            self._renderer = renderer_of(self._world)
            self._renderer.open()

    def close(self) -> None:
        """Release the renderer. May be called twice."""
        renderer, self._renderer = self._renderer, None
        if renderer is not None:
            renderer.close()

    def frame(self, camera: str) -> Frame | None:
        """The current image; ``None`` while the robot is not connected.

        Raises:
            DriverError: Unknown camera, or rendering is not available.
        """
        renderer = self._renderer
        if renderer is None:
            return None
        if camera not in self._cameras:
            raise DriverError(f"no camera '{camera[:80]}'; available cameras: {', '.join(self._cameras)}")
        try:
            image = renderer.render(self._cameras[camera], width=_WIDTH, height=_HEIGHT)
        except SensorError as error:
            raise DriverError(str(error)) from error
        content = simplejpeg.encode_jpeg(image.pixels, quality=_QUALITY, colorsubsampling="420")
        return Frame(_WIDTH, _HEIGHT, content, image.taken_s)

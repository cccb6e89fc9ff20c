"""Cameras of a simulated room: colour and depth, fixed or on a pan-tilt head."""

import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import simplejpeg

from device_agent.ports.sensor import Bytes, Capture, Depths, Frame, Image, SensorError
from device_agent.ports.simulation import SimulatedWorld
from device_agent.protocol import camera_frames
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors import png
from device_agent.sensors.frames import declared_camera, depth_capture, depth_frame, people_frame
from device_agent.sensors.mujoco.base import SimulatedSensor
from device_agent.sensors.mujoco.noise import generator
from device_agent.sensors.mujoco.people_tracker import CameraPose, PeopleTracker
from device_agent.simulation.renderer import Renderer, renderer_of

FRESH_S = 0.1
"""Maximum age of the image that ``raw`` returns."""
_WIDTH, _HEIGHT = 320, 240
_QUALITY = 75
_GRAIN = 1.5
"""Standard deviation of colour noise, of 255: a small sensor in a lit room, approximate."""
_TILES = 64
"""Noise is generated once, larger than the image by this in each direction, and shifted randomly per image."""
_NEAREST_M, _FURTHEST_M = 0.3, 8.0


class Camera(SimulatedSensor):
    """Base class of both cameras.

    Options: ``camera``, its name in the room's model (default: the device's name); ``width`` and ``height`` [px].
    """

    OPTIONS: Mapping[str, type | tuple[type, ...]] = {"camera": str, "width": int, "height": int}
    DEPTH = False

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld) -> None:
        super().__init__(device, world)
        self._name: str = self.option("camera", device.name)
        self._width: int = self.option("width", _WIDTH)
        self._height: int = self.option("height", _HEIGHT)
        if not (0 < self._width <= 1920 and 0 < self._height <= 1080):  # noqa: PLR2004 (1080p)
            raise SensorError(
                f"pictures of '{device.name}' are at most 1920 x 1080, not {self._width} x {self._height}"
            )
        self._random = generator(device.name, self.option("seed", 0))
        self._renderer: Renderer | None = None
        self._camera = 0
        self._fovy_rad = 0.0
        self._newest: Image | None = None

    def on_connect(self, model: Any) -> None:
        """See ``SimulatedSensor``."""
        self._camera = self.find(model, "camera", self._name)
        self._fovy_rad = math.radians(float(model.cam_fovy[self._camera]))
        self._renderer = renderer_of(self._world)
        self._renderer.open()

    def on_close(self) -> None:
        """See ``SimulatedSensor``."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self._newest = None

    def raw(self) -> Image:
        """See ``RoomDriver``."""
        newest = self._newest
        if newest is None or time.monotonic() - newest.taken_s > FRESH_S:
            newest = self._take()
        return newest

    def _take(self) -> Image:
        self.require()
        renderer = self._renderer
        if renderer is None:
            raise SensorError(f"'{self._device.name}' is not connected")
        rendered = renderer.render(self._camera, width=self._width, height=self._height, depth=self.DEPTH)
        rgb, depth_m = self._measure(rendered.pixels)
        self._newest = image = Image(
            taken_s=rendered.taken_s,
            position_m=rendered.position_m,
            rotation=rendered.rotation,
            fovy_rad=self._fovy_rad,
            rgb=rgb,
            depth_m=depth_m,
        )
        return image

    def _measure(self, pixels: Any) -> tuple[Bytes | None, Depths | None]:
        """Rendered pixels with noise: colours, or depth [m]."""
        raise NotImplementedError

    def _shifted(self, noise: Any) -> Any:
        """A random part of prepared noise, as large as the image."""
        down, right = self._random.integers(0, _TILES, 2).tolist()
        return noise[down : down + self._height, right : right + self._width]


class ColourCamera(Camera):
    """Frames of the kind ``colour``; capture ``image``: a lossless PNG."""

    FRAMES = (camera_frames.COLOUR,)

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld) -> None:
        super().__init__(device, world)
        grain = self._random.normal(0.0, _GRAIN, (self._height + _TILES, self._width + _TILES, 3))
        self._grain = np.rint(grain).astype(np.int16)

    def frame(self, camera: str) -> Frame:
        """See ``ports.sensor.Camera``."""
        declared_camera(self._device, camera)
        image = self._take()
        content = simplejpeg.encode_jpeg(image.rgb, quality=_QUALITY, colorsubsampling="420")
        return Frame(self._width, self._height, content, image.taken_s)

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self._device.captures:
            return super().capture(name)
        return Capture("image/png", png.encode(self._take().rgb))

    def _measure(self, pixels: Any) -> tuple[Bytes | None, Depths | None]:
        grainy = pixels.astype(np.int16) + self._shifted(self._grain)
        return np.clip(grainy, 0, 255).astype(np.uint8), None


class DepthCamera(Camera):
    """Frames of the kind ``depth`` and capture ``depth``: a 16-bit PNG in millimetres, 0 without an echo.

    Frames of the kind ``people``: see ``people_tracker``.

    Noise of structured light: standard deviation 1.2 mm + 1.9 mm/m² (z - 0.4 m)², from Nguyen, Izadi and Lovell,
    "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking", 2012.

    Additional options: ``nearest_m``, ``furthest_m``.
    """

    OPTIONS: Mapping[str, type | tuple[type, ...]] = {
        **Camera.OPTIONS,
        "nearest_m": (int, float),
        "furthest_m": (int, float),
    }
    DEPTH = True
    FRAMES = (camera_frames.DEPTH, camera_frames.PEOPLE)

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld) -> None:
        super().__init__(device, world)
        self._nearest_m = float(self.option("nearest_m", _NEAREST_M))
        self._furthest_m = float(self.option("furthest_m", _FURTHEST_M))
        noise = self._random.normal(0.0, 1.0, (self._height + _TILES, self._width + _TILES))
        self._noise = noise.astype(np.float32)
        self._tracker: PeopleTracker | None = None

    def on_connect(self, model: Any) -> None:
        """See ``SimulatedSensor``."""
        super().on_connect(model)
        own_body = int(model.cam_bodyid[self._camera]) or -1  # the walls belong to body 0
        self._tracker = PeopleTracker(model, random=self._random, noise_m=_deviation, own_body=own_body)

    def frame(self, camera: str) -> Frame:
        """See ``ports.sensor.Camera``."""
        if declared_camera(self._device, camera).kind == camera_frames.DEPTH:
            return depth_frame(self.raw())  # shared with perception
        return self._track_people()

    def _track_people(self) -> Frame:
        self.require()
        tracker, high = self._tracker, math.tan(self._fovy_rad / 2)
        if tracker is None:
            raise SensorError(f"'{self._device.name}' is not connected")
        with self.view.current() as (data, taken_s):
            position_m = data.cam_xpos[self._camera].copy()
            rotation = data.cam_xmat[self._camera].reshape(3, 3).copy()
            pose = CameraPose(position_m, rotation, (high * self._width / self._height, high))
            people = tracker.track(data, pose)
        return people_frame(people, taken_s=taken_s, position_m=position_m, rotation=rotation, fovy_rad=self._fovy_rad)

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self._device.captures:
            return super().capture(name)
        return depth_capture(np.asarray(self._take().depth_m))

    def _measure(self, pixels: Any) -> tuple[Bytes | None, Depths | None]:
        depth_m = pixels + self._shifted(self._noise) * _deviation(pixels)
        depth_m[(pixels < self._nearest_m) | (pixels > self._furthest_m)] = np.inf
        return None, depth_m


def _deviation(depth_m: Any) -> Any:
    """Standard deviation of structured light at a depth [m], in the precision of the argument."""
    one = depth_m.dtype.type
    return one(0.0012) + one(0.0019) * np.square(depth_m - one(0.4))

"""Cameras over ROS: raw pictures, JPEGs and depths."""

from collections.abc import Sequence
from typing import Any, ClassVar

from device_agent.middleware.ros import images
from device_agent.middleware.ros.images import RawImage
from device_agent.middleware.ros.messages import CompressedImage
from device_agent.ports.sensor import Bytes, Capture, Depths, Frame, Image
from device_agent.protocol import camera_frames
from device_agent.protocol.camera_frames import jpeg_size
from device_agent.sensors import png
from device_agent.sensors.frames import declared_camera, depth_capture, depth_frame
from device_agent.sensors.ros.base import RosSensor


class _Camera(RosSensor):
    """Frames of the kind ``colour``."""

    CAPTURES: ClassVar[Sequence[str]] = ("image",)
    FRAMES: ClassVar[Sequence[str]] = (camera_frames.COLOUR,)

    def frame(self, camera: str) -> Frame:
        """See ``ports.sensor.Camera``."""
        declared_camera(self.device, camera)
        message, at_s = self.newest()
        width, height, content = self._jpeg(message)
        return Frame(width, height, content, at_s)

    def raw(self) -> Image:
        """See ``RoomDriver``."""
        message, at_s = self.newest()
        (rgb, depth_m), (position_m, rotation) = self._arrays(message), self.pose()
        return Image(
            taken_s=at_s,
            position_m=position_m,
            rotation=rotation,
            fovy_rad=self.options.fovy_rad,
            rgb=rgb,
            depth_m=depth_m,
        )

    def _jpeg(self, message: Any) -> tuple[int, int, bytes]:
        raise NotImplementedError

    def _arrays(self, message: Any) -> tuple[Bytes | None, Depths | None]:
        raise NotImplementedError


class ColourCamera(_Camera):
    """Raw pictures with rgb8, bgr8 or mono8. Capture ``image``: a lossless PNG."""

    TYPE, MESSAGE = "sensor_msgs/Image", RawImage

    def check(self, message: RawImage) -> None:
        """See ``RosSensor``."""
        images.colours(message)

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self.CAPTURES:
            return super().capture(name)
        return Capture("image/png", png.encode(images.colours(self.newest()[0])))

    def _jpeg(self, message: RawImage) -> tuple[int, int, bytes]:
        return images.to_jpeg(images.colours(message))

    def _arrays(self, message: RawImage) -> tuple[Bytes | None, Depths | None]:
        return images.colours(message).copy(), None


class CompressedCamera(_Camera):
    """JPEGs. Capture ``image``: the JPEG as it was received."""

    TYPE, MESSAGE = "sensor_msgs/CompressedImage", CompressedImage

    def check(self, message: CompressedImage) -> None:
        """See ``RosSensor``."""
        images.from_jpeg(message.data)

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self.CAPTURES:
            return super().capture(name)
        return Capture("image/jpeg", self.newest()[0].data)

    def _jpeg(self, message: CompressedImage) -> tuple[int, int, bytes]:
        if len(message.data) > images.MAX_JPEG:
            return images.to_jpeg(images.from_jpeg(message.data))
        return *jpeg_size(message.data), message.data

    def _arrays(self, message: CompressedImage) -> tuple[Bytes | None, Depths | None]:
        return images.from_jpeg(message.data), None


class DepthCamera(_Camera):
    """Depths with 16UC1 [mm] or 32FC1 [m].

    Frames of the kind ``depth`` and capture ``depth``: a 16-bit PNG in millimetres, 0 without an echo. Frames of the
    kind ``colour``: depths as grey values.
    """

    TYPE, MESSAGE = "sensor_msgs/Image", RawImage
    CAPTURES = ("depth",)
    FRAMES = (camera_frames.COLOUR, camera_frames.DEPTH)

    def check(self, message: RawImage) -> None:
        """See ``RosSensor``."""
        images.depths(message)

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self.CAPTURES:
            return super().capture(name)
        return depth_capture(images.depths(self.newest()[0]))

    def frame(self, camera: str) -> Frame:
        """See ``ports.sensor.Camera``."""
        if declared_camera(self.device, camera).kind == camera_frames.DEPTH:
            return depth_frame(self.raw())
        return super().frame(camera)

    def _jpeg(self, message: RawImage) -> tuple[int, int, bytes]:
        return images.to_jpeg(images.displayed(images.depths(message)))

    def _arrays(self, message: RawImage) -> tuple[Bytes | None, Depths | None]:
        return None, images.depths(message)

"""The newest picture of each camera."""

from collections.abc import Mapping

from device_agent.middleware.ros import images
from device_agent.middleware.ros.images import RawImage
from device_agent.middleware.ros.messages import CompressedImage
from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Bytes, Frame
from device_agent.protocol.camera_frames import jpeg_size


class Pictures:
    """The newest picture of each camera. Written by one thread, read by any.

    Args:
        cameras: Cameras that have a topic.
    """

    def __init__(self, cameras: Mapping[str, object]) -> None:
        self._cameras = cameras
        self._newest: dict[str, tuple[Frame | Bytes, float]] = {}

    def accept(self, camera: str, message: CompressedImage, at_s: float) -> None:
        """Use a JPEG that arrived at ``at_s`` [s].

        Raises:
            ValueError: It is no JPEG.
        """
        width, height = jpeg_size(message.data)
        self._newest[camera] = Frame(width, height, message.data, at_s), at_s

    def accept_raw(self, camera: str, message: RawImage, at_s: float) -> None:
        """Use a raw picture that arrived at ``at_s`` [s].

        Raises:
            ValueError: Its encoding is not supported, or its data have another size.
        """
        is_depth = images.is_depth(message)
        self._newest[camera] = images.displayed(images.depths(message)) if is_depth else images.colours(message), at_s

    def take(self, camera: str) -> Frame | None:
        """The newest picture, once; ``None`` if there is no new one. Raw pictures become JPEGs here.

        Raises:
            DriverError: The camera has no topic.
        """
        if camera not in self._cameras:
            raise DriverError(f"option 'cameras' names no topic for '{camera}'")
        newest, at_s = self._newest.pop(camera, (None, 0.0))
        if newest is None or isinstance(newest, Frame):
            return newest
        width, height, content = images.to_jpeg(newest)
        return Frame(width, height, content, at_s)

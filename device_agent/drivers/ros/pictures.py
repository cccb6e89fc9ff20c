"""Pictures from ``CompressedImage`` messages."""

from collections.abc import Mapping

from device_agent.drivers.ros.messages import CompressedImage
from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Frame
from device_agent.protocol.camera_frames import jpeg_size


class Pictures:
    """The newest picture of each camera. Written by one thread, read by any.

    Args:
        cameras: Camera of the robot type → topic.
    """

    def __init__(self, cameras: Mapping[str, str]) -> None:
        self._cameras = cameras
        self._newest: dict[str, Frame] = {}

    def accept(self, camera: str, message: CompressedImage, at_s: float) -> None:
        """Use a picture that arrived at ``at_s`` [s].

        Raises:
            ValueError: It is no JPEG.
        """
        width, height = jpeg_size(message.data)
        self._newest[camera] = Frame(width, height, message.data, at_s)

    def take(self, camera: str) -> Frame | None:
        """The newest picture, once; ``None`` if there is no new one.

        Raises:
            DriverError: The camera has no topic.
        """
        if camera not in self._cameras:
            raise DriverError(f"option 'cameras' names no topic for '{camera}'")
        return self._newest.pop(camera, None)

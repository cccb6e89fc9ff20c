"""Pictures from ``CompressedImage`` messages."""

import struct
from collections.abc import Mapping

from device_agent.middleware.ros.messages import CompressedImage
from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import Frame

_START = b"\xff\xd8"
_MARKER = 0xFF
_STANDALONE = {0x01, *range(0xD0, 0xDA)}
_SIZED = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that start a frame."""


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


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height of a JPEG [pixels].

    Raises:
        ValueError: It is no JPEG.
    """
    position = len(_START)
    while data.startswith(_START) and position + 9 <= len(data) and data[position] == _MARKER:
        marker = data[position + 1]
        if marker in _STANDALONE:
            position += 2
            continue
        length, _, height, width = struct.unpack_from(">HBHH", data, position + 2)
        if marker in _SIZED:
            return width, height
        position += 2 + length
    raise ValueError("a picture is no JPEG")

"""Contents of frames, decoded by libraries that the agent does not use for them."""

from typing import Any

import cv2
import msgspec
import numpy as np
import simplejpeg

from device_agent.ports.sensor import Frame
from device_agent.protocol import LidarScan, TrackedPeople, camera_frames


def depths_mm(content: bytes) -> Any:
    """Depths of a 16-bit PNG, shape (height, width) [mm]."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.dtype == np.uint16
    return image


def scan(content: bytes) -> LidarScan:
    """A frame of the kind ``scan``."""
    found = msgspec.json.decode(content, type=LidarScan, strict=True)
    assert len(found.angle_rad) == len(found.range_m)
    return found


def people(content: bytes) -> TrackedPeople:
    """A frame of the kind ``people``."""
    return msgspec.json.decode(content, type=TrackedPeople, strict=True)


def frame_size(frame: Frame) -> tuple[int, int]:
    """Width and height by the content of a frame."""
    match frame.kind:
        case camera_frames.COLOUR:
            height, width, _ = simplejpeg.decode_jpeg(frame.content).shape
            return width, height
        case camera_frames.DEPTH:
            height, width = depths_mm(frame.content).shape
            return width, height
        case camera_frames.SCAN:
            return len(scan(frame.content).range_m), 1
    return len(people(frame.content).people), 1

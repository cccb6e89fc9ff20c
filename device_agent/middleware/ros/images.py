"""Pictures from ``sensor_msgs/Image`` and ``CompressedImage``, and JPEGs of limited size."""

import math
from typing import Any

import msgspec
import numpy as np
import simplejpeg

from device_agent.ports.sensor import Bytes, Depths

MAX_JPEG = 120 * 1024
"""A frame is at most 128 KB with its header [bytes]."""
MAX_WIDTH = 640
"""Wider pictures are reduced by a whole factor [pixels]."""
DISPLAYED_M = 8.0
"""Depths from 0 to this value are shown as white to black [m]."""
_QUALITIES = (75, 55, 35)
_COLOURS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "mono8": (0, 0, 0)}
_DEPTHS = {"16UC1": "u2", "32FC1": "f4"}
_MILLIMETRE = 0.001


class RawImage(msgspec.Struct, frozen=True):
    """``sensor_msgs/Image``. The data are Base64 in JSON. ``step``: length of a row [bytes]."""

    height: int
    width: int
    encoding: str
    step: int
    data: bytes
    is_bigendian: int = 0


def colours(image: RawImage) -> Bytes:
    """Colours of a picture with rgb8, bgr8 or mono8, shape (height, width, 3).

    Raises:
        ValueError: Another encoding, or data of another size.
    """
    order = _COLOURS.get(image.encoding)
    if order is None:
        raise ValueError(f"a picture has the encoding '{image.encoding[:20]}'; use {', '.join(_COLOURS)}")
    channels = 1 if image.encoding == "mono8" else len(order)
    return np.asarray(_rows(image, "u1", channels)[:, :, order])


def depths(image: RawImage) -> Depths:
    """Depths of a picture with 16UC1 or 32FC1, shape (height, width) [m]; ``inf`` without a measurement.

    Raises:
        ValueError: Another encoding, or data of another size.
    """
    kind = _DEPTHS.get(image.encoding)
    if kind is None:
        raise ValueError(f"a depth picture has the encoding '{image.encoding[:20]}'; use {', '.join(_DEPTHS)}")
    values = _rows(image, kind, 1)[:, :, 0].astype(np.float32)
    if image.encoding == "16UC1":
        values *= np.float32(_MILLIMETRE)
    return np.asarray(np.where(np.isfinite(values) & (values > 0), values, np.float32(np.inf)))


def displayed(depth_m: Depths) -> Bytes:
    """A depth picture as grey values, shape (height, width, 3): white is near, black is far or not measured."""
    grey = np.clip(255 * (1 - depth_m / DISPLAYED_M), 0, 255).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def is_depth(image: RawImage) -> bool:
    """Whether a picture contains depths."""
    return image.encoding in _DEPTHS


def to_jpeg(pixels: Bytes) -> tuple[int, int, bytes]:
    """Width, height and JPEG of at most ``MAX_JPEG`` bytes.

    Args:
        pixels: Colours, shape (height, width, 3). Large pictures are reduced by whole factors.
    """
    factor = math.ceil(pixels.shape[1] / MAX_WIDTH)
    while True:
        reduced = np.ascontiguousarray(pixels[::factor, ::factor])
        for quality in _QUALITIES:
            content = bytes(simplejpeg.encode_jpeg(reduced, quality=quality, colorsubsampling="420"))
            if len(content) <= MAX_JPEG:
                return reduced.shape[1], reduced.shape[0], content
        factor += 1


def from_jpeg(content: bytes) -> Bytes:
    """Colours of a JPEG, shape (height, width, 3).

    Raises:
        ValueError: It is damaged.
    """
    return np.asarray(simplejpeg.decode_jpeg(content))


def _rows(image: RawImage, kind: str, channels: int) -> Any:
    """The values without padding, shape (height, width, channels)."""
    dtype = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    length = image.width * channels * dtype.itemsize
    if image.width < 1 or image.height < 1 or image.step < length or len(image.data) < image.step * image.height:
        raise ValueError(f"a picture of {image.width} x {image.height} has {len(image.data)} bytes")
    strides = (image.step, channels * dtype.itemsize, dtype.itemsize)
    return np.ndarray((image.height, image.width, channels), dtype, image.data, strides=strides)

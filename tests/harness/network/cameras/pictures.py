"""Pictures for emulated cameras."""

import numpy as np
import numpy.typing as npt
import simplejpeg

WIDTH, HEIGHT = 64, 48


def rgb(number: int, width: int = WIDTH, height: int = HEIGHT) -> npt.NDArray[np.uint8]:
    """A picture whose brightness tells its number."""
    picture = np.full((height, width, 3), 40 + number % 160, dtype=np.uint8)
    picture[: height // 2, : width // 2] = 255
    return picture


def jpeg(number: int, width: int = WIDTH, height: int = HEIGHT) -> bytes:
    return bytes(simplejpeg.encode_jpeg(rgb(number, width, height), quality=90, colorsubsampling="420"))

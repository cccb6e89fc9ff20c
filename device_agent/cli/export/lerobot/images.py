"""Images of a recording: decoding, and encoding as video."""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import av
import msgspec
import numpy as np
from av.error import FFmpegError
from av.video.frame import VideoFrame
from msgspec import Struct
from numpy.typing import NDArray

from device_agent.cli.export.errors import ExportError
from device_agent.cli.export.request import ExportRequest
from device_agent.cli.export.segments import Entry, decode

if TYPE_CHECKING:
    from av.video.stream import VideoStream

CODEC: Final = "h264"
_ENCODER: Final = "libx264"
_QUALITY: Final = "18"
"""Constant rate factor of x264: visually lossless."""
_KEYFRAME_EVERY: Final = 2
"""Frames from one keyframe to the next: training reads frames in random order."""
_JPEG: Final = frozenset({"jpeg", "jpg"})
"""Formats of recorded colour images."""


class Image(Struct, frozen=True, kw_only=True):
    """The fields of ``foxglove.CompressedImage`` that the export needs."""

    data: bytes
    format: str


_images = msgspec.json.Decoder(Image)


class Decoder:
    """Decodes the JPEG images of one camera."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._codec = av.CodecContext.create("mjpeg", "r")
        self.size: tuple[int, int] | None = None
        """Width and height of the first image [pixels]."""

    def decode(self, entry: Entry) -> NDArray[np.uint8]:
        """Pixels of an image message, shape (height, width, 3), red first.

        Raises:
            ExportError: The image is damaged, or has another size than the first one.
        """
        try:
            frame = self._codec.decode(av.Packet(read_image(entry).data))[0]
        except (FFmpegError, IndexError) as error:
            raise ExportError(f"an image of {self._topic} is damaged; add --camera to leave this camera out") from error
        if self.size is None:
            self.size = frame.width, frame.height
        if self.size != (frame.width, frame.height):
            raise ExportError(
                f"{self._topic} has images of {self.size[0]} x {self.size[1]} and {frame.width} x {frame.height} "
                "pixels; add --camera to leave this camera out, or export episodes with one size"
            )
        return cast("NDArray[np.uint8]", frame.to_ndarray(format="rgb24"))


class VideoWriter:
    """Writes one MP4 file with H.264.

    Args:
        path: New file.
        fps: Frames a second [Hz].
        size: Width and height [pixels].
    """

    def __init__(self, path: Path, fps: int, size: tuple[int, int]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.pixel_format = "yuv444p" if size[0] % 2 or size[1] % 2 else "yuv420p"  # which needs even sizes
        self._container = av.open(str(path), "w")
        options = {"crf": _QUALITY, "preset": "veryfast", "x264-params": "log-level=error"}
        stream: Any = self._container.add_stream(_ENCODER, rate=fps, options=options)
        self._stream: VideoStream = stream
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = self.pixel_format
        self._stream.gop_size, self._stream.max_b_frames = _KEYFRAME_EVERY, 0
        self._time_base, self._count = Fraction(1, fps), 0

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """Append one frame, shape (height, width, 3)."""
        frame = VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format=self.pixel_format)
        frame.pts, frame.time_base = self._count, self._time_base
        self._count += 1
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write the remaining frames and end the file."""
        self._container.mux(self._stream.encode(None))
        self._container.close()


def read_image(entry: Entry) -> Image:
    """The fields of an image message.

    Raises:
        ExportError: It is no ``foxglove.CompressedImage``.
    """
    return decode(_images, entry)


def colour_cameras(request: ExportRequest) -> tuple[str, ...]:
    """Topics of the requested cameras that have JPEG images in the recording.

    Raises:
        ExportError: The recording cannot be read.
    """
    formats: dict[str, str] = {}
    if request.cameras:
        for entry in request.recording.entries(topics=request.cameras):
            if entry.topic not in formats:
                formats[entry.topic] = read_image(entry).format
                if len(formats) == len(request.cameras):
                    break
    return tuple(topic for topic in request.cameras if formats.get(topic) in _JPEG)


def images(request: ExportRequest, topic: str, times_ns: Sequence[int]) -> Iterator[Entry]:
    """The image messages with these log times, which ascend and may repeat.

    Raises:
        ExportError: The recording cannot be read.
    """
    position = 0
    for entry in request.recording.entries((times_ns[0], times_ns[-1]), (topic,)):
        while position < len(times_ns) and times_ns[position] == entry.time_ns:
            yield entry
            position += 1

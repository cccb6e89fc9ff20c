"""Program that decodes a camera and writes JPEGs, in a process of its own. Of the agent it imports only Landlock.

A library that blocks or crashes on a damaged stream ends only this process. Input: one line of JSON with the settings;
the end of the input ends the program, so that it does not outlive the agent. Output: messages of ``HEADER``, each
followed by a JPEG, or at the end by a reason of ``REASONS``. Settings are not arguments, which other users can read.
"""

import contextlib
import errno
import fcntl
import json
import math
import os
import resource
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

HEADER = struct.Struct("!cdHHI")
"""Kind, time of arrival on the monotonic clock [s], width and height [pixels], length of the content."""
FRAME, END = b"F", b"E"
REASONS = frozenset({
    "busy", "denied", "ended", "invalid", "library", "missing", "no-capture", "no-video", "not-found", "oversized",
    "rejected", "timeout", "unreachable",
})  # fmt: skip
_NICENESS = 5
"""Decoding uses much processor time; control loops take precedence."""
_MAX_MEMORY_BYTES = 2 * 1024**3
_MAX_PIXELS = 4096 * 2304
_MAX_DAMAGED = 200
"""Damaged packets in a row until the stream is given up."""
_EARLY = 0.9
"""A frame may follow this share of a period after the previous one, as cameras do not keep their rate exactly."""
_SCALES = (2, 5, 12, 31)
"""Quantizers of FFmpeg's JPEG encoder; a larger one gives a smaller picture."""
_QUALITIES = (85, 60, 35, 10)
_QP_TO_LAMBDA = 118
_QUERY_CAPABILITIES = 0x80685600
"""``VIDIOC_QUERYCAP`` of the kernel's ``videodev2.h``: fills 104 bytes; ``device_caps`` is at byte 88."""
_CAPABILITIES, _DEVICE_CAPABILITIES = slice(84, 88), slice(88, 92)
_VIDEO_CAPTURE, _HAS_DEVICE_CAPABILITIES = 0x1, 0x80000000

Picture = tuple[float, int, int, bytes]
"""Time of arrival on the monotonic clock [s], width and height [pixels], and the JPEG."""
Grab = Callable[[dict[str, Any]], Iterator[Picture]]


class EndError(Exception):
    """The stream has ended with one of ``REASONS``."""


def main() -> int:
    """Decode until the stream or the input ends; returns the exit code."""
    output = os.fdopen(os.dup(sys.stdout.fileno()), "wb", buffering=0)
    settings = json.loads(sys.stdin.readline())
    os.nice(_NICENESS)
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY_BYTES, _MAX_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a memory dump would contain the password
    reason = "ended"
    try:
        for arrived_s, width, height, jpeg in SOURCES[settings["source"]](settings):
            output.write(HEADER.pack(FRAME, arrived_s, width, height, len(jpeg)) + jpeg)
    except EndError as error:
        reason = str(error)
    except ImportError:
        reason = "library"
    except MemoryError:
        reason = "oversized"
    output.write(HEADER.pack(END, time.monotonic(), 0, 0, len(reason)) + reason.encode())
    return 0


def _watch_the_input() -> None:
    """End with the input. Started after ``confine``, which applies to later threads only."""
    threading.Thread(target=_end_with_the_input, daemon=True).start()


def _end_with_the_input() -> None:
    while sys.stdin.read(1):
        pass
    os._exit(0)


def _due(rate_hz: float) -> Iterator[bool]:
    """Whether the frame that has just arrived is published."""
    last_s = 0.0
    while True:
        now_s = time.monotonic()
        due = now_s - last_s >= _EARLY / rate_hz
        if due:
            last_s = now_s
        yield due


# ------------------------------------------------------------ RTSP


def _rtsp(settings: dict[str, Any]) -> Iterator[Picture]:
    """Decode an RTSP stream over TCP. Every frame is decoded, as each depends on earlier ones."""
    import av  # noqa: PLC0415 (only this source needs it)

    av.logging.set_level(None)
    address, port = _resolved(str(settings["host"]), int(settings["port"]))
    url = str(settings["url"]).format(host=address)
    confine(port)
    _watch_the_input()
    timeout_s = float(settings["timeout_s"])
    options = {
        "rtsp_transport": "tcp",
        "allowed_media_types": "video",
        "timeout": str(round(timeout_s * 1e6)),
        "fflags": "nobuffer",
        "flags": "low_delay",
    }
    due = _due(float(settings["rate_hz"]))
    start_s = time.monotonic()
    try:
        with av.open(url, format="rtsp", options=options, timeout=timeout_s) as container:
            start_s = math.inf
            if not container.streams.video:
                raise EndError("no-video")
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            for frame in _decoded(container, stream):
                if next(due):
                    yield _scaled_jpeg(frame, int(settings["width"]), int(settings["max_bytes"]))
    except av.FFmpegError as error:
        # FFmpeg reports a server without any response as invalid data.
        silent = time.monotonic() - start_s >= _EARLY * timeout_s
        raise EndError("timeout" if silent else _ffmpeg_reason(error)) from error


def _resolved(host: str, port: int) -> tuple[str, int]:
    """The address of the camera as a part of an URL, and its port; a confined process cannot look names up."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        raise EndError("unreachable") from error
    address = str(found[0][4][0])
    return f"[{address}]" if ":" in address else address, port


def confine(port: int) -> None:
    """Deny this process all files except Python's packages, and other ports, where the kernel has Landlock.

    A stream that takes over the library then reads no key of the agent. A redirect reaches no other port. PyAV imports
    some of its modules when it needs them.
    """
    packages = [folder for folder in sys.path if folder and Path(folder).is_dir()]
    sys.path.append(str(Path(__file__).resolve().parents[3]))
    from device_agent.sandbox import landlock, privileges  # noqa: PLC0415 (needs the path)

    if landlock.abi():
        privileges.renounce()
        landlock.restrict(packages, connect=port)


def _decoded(container: Any, stream: Any) -> Iterator[Any]:
    """Decoded frames; damaged packets are skipped, as after the loss of a keyframe."""
    import av  # noqa: PLC0415 (as above)

    damaged = 0
    for packet in container.demux(stream):
        try:
            frames = packet.decode()
        except av.error.InvalidDataError as error:
            damaged += 1
            if damaged > _MAX_DAMAGED:
                raise EndError("invalid") from error
            continue
        for frame in frames:
            damaged = 0
            if frame.width * frame.height > _MAX_PIXELS:
                raise EndError("oversized")
            yield frame


def _scaled_jpeg(frame: Any, max_width: int, max_bytes: int) -> Picture:
    """The frame as a JPEG, at most as wide and as long as allowed."""
    import av  # noqa: PLC0415 (as above)

    arrived_s = time.monotonic()
    width = min(frame.width, max_width) // 2 * 2
    height = max(2, round(frame.height * width / frame.width) // 2 * 2)
    picture = frame.reformat(width, height, "yuvj420p")
    picture.pts = 0
    for scale in _SCALES:
        encoder = av.CodecContext.create("mjpeg", "w")
        encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuvj420p"
        encoder.time_base = Fraction(1, 25)
        encoder.options = {"flags": "+qscale", "global_quality": str(scale * _QP_TO_LAMBDA)}
        jpeg = b"".join(bytes(packet) for packet in (*encoder.encode(picture), *encoder.encode(None)))
        if len(jpeg) <= max_bytes:
            return arrived_s, width, height, jpeg
    raise EndError("oversized")


def _ffmpeg_reason(error: Any) -> str:
    import av  # noqa: PLC0415 (as above)

    reasons = (
        ((av.error.HTTPUnauthorizedError, av.error.HTTPForbiddenError), "rejected"),
        (av.error.HTTPNotFoundError, "not-found"),
        (av.error.EOFError, "ended"),
        ((av.error.TimeoutError, av.error.ExitError), "timeout"),
        ((av.error.InvalidDataError, av.error.HTTPError, av.error.DecoderNotFoundError), "invalid"),
    )
    return next((reason for kinds, reason in reasons if isinstance(error, kinds)), "unreachable")


# ------------------------------------------------------------ cameras of this machine


def _v4l2(settings: dict[str, Any]) -> Iterator[Picture]:
    """Read a camera of this machine; its own JPEGs are decoded and encoded again, which repairs incomplete ones."""
    _watch_the_input()
    device = str(settings["device"])
    _check_capture_device(device)
    # OpenCV reads it once, when its module is loaded.
    os.environ["OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT"] = str(max(1, round(float(settings["timeout_s"]))))
    import cv2  # noqa: PLC0415 (only this source needs it)

    cv2.setNumThreads(1)
    wanted = {
        cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"MJPG"),
        cv2.CAP_PROP_FRAME_WIDTH: int(settings["width"]),
        cv2.CAP_PROP_FRAME_HEIGHT: int(settings["height"]),
        cv2.CAP_PROP_BUFFERSIZE: 1,
    }
    camera = cv2.VideoCapture(device, cv2.CAP_V4L2, [number for pair in wanted.items() for number in pair])
    due = _due(float(settings["rate_hz"]))
    with contextlib.closing(_Releasing(camera)):
        if not camera.isOpened():
            raise EndError("busy")
        while True:
            received, image = camera.read()
            if not received:
                raise EndError("timeout")
            if next(due):
                yield encoded(image, int(settings["max_bytes"]))


class _Releasing:
    """Gives OpenCV's ``release`` the usual name."""

    def __init__(self, camera: Any) -> None:
        self.close = camera.release


def _check_capture_device(device: str) -> None:
    """Require a device that captures video; OpenCV does not tell why it cannot open one."""
    capability = bytearray(104)
    try:
        opened = os.open(device, os.O_RDWR | os.O_NONBLOCK)
        try:
            fcntl.ioctl(opened, _QUERY_CAPABILITIES, capability)
        finally:
            os.close(opened)
    except OSError as error:
        reasons = {errno.ENOENT: "missing", errno.ENODEV: "missing", errno.EACCES: "denied", errno.EPERM: "denied"}
        raise EndError(reasons.get(error.errno or 0, "no-capture")) from error
    capabilities = int.from_bytes(capability[_CAPABILITIES], sys.byteorder)
    if capabilities & _HAS_DEVICE_CAPABILITIES:
        capabilities = int.from_bytes(capability[_DEVICE_CAPABILITIES], sys.byteorder)
    if not capabilities & _VIDEO_CAPTURE:
        raise EndError("no-capture")


def encoded(image: Any, max_bytes: int) -> Picture:
    """An image of OpenCV as a JPEG of limited length."""
    import cv2  # noqa: PLC0415 (as above)

    arrived_s = time.monotonic()
    height, width = image.shape[:2]
    for quality in _QUALITIES:
        jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(jpeg) <= max_bytes:
            return arrived_s, width, height, jpeg
    raise EndError("oversized")


SOURCES: dict[str, Grab] = {"rtsp": _rtsp, "v4l2": _v4l2}

if __name__ == "__main__":
    sys.exit(main())

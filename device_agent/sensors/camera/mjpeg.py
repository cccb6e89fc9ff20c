"""Cameras that send JPEGs over HTTP: a multipart stream, or one picture at each request."""

import threading
import time
from collections.abc import Iterator
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from urllib.parse import SplitResult

from device_agent.ports.sensor import Frame, RoomDriver, SensorError, Surroundings
from device_agent.protocol.camera_frames import MAX_CONTENT_BYTES, jpeg_size
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.camera.driver import CameraDriver
from device_agent.sensors.camera.http_client import CameraClient, failure
from device_agent.sensors.camera.multipart import MultipartError, MultipartParser, boundary_of
from device_agent.sensors.camera.options import (
    Credentials,
    NetworkCamera,
    credentials,
    parse,
    shown,
    split_address,
    tls_context,
    with_files,
)

_CHUNK_BYTES = 64 * 1024


class Options(NetworkCamera, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver ``mjpeg``.

    Attributes:
        ca: File with the certificate of the camera or of its authority (PEM), relative to the agent's folder. Empty:
            the authorities of the system.
    """

    ca: str = ""


class MjpegSource:
    """One camera. The response's content type decides between a stream and single pictures."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self._address = split_address(options.url, ("http", "https"))
        self._aborted = threading.Event()
        self._client = CameraClient(timeout_s=options.stale_s, tls=lambda: tls_context(options.ca))

    def frames(self) -> Iterator[Frame]:
        """See ``FrameSource``."""
        self._aborted.clear()
        known = credentials(self._options)
        response = self._client.open(self._address, known)
        try:
            content_type = response.headers.get("Content-Type", "")
            if content_type.lower().startswith("multipart/"):
                yield from self._stream(response, content_type)
            else:
                yield from self._pictures(response, known)
        except MultipartError as error:
            raise SensorError(f"{shown(self._address)}: {error}") from error
        except TimeoutError as error:
            raise SensorError(f"{shown(self._address)} sends no new pictures; restart the camera") from error
        except (OSError, HTTPException, ValueError) as error:
            raise failure(self._address, error) from error
        finally:
            self._client.close()

    def abort(self) -> None:
        """See ``FrameSource``."""
        self._aborted.set()
        self._client.abort()

    def _stream(self, response: HTTPResponse, content_type: str) -> Iterator[Frame]:
        parser = MultipartParser(boundary_of(content_type), MAX_CONTENT_BYTES)
        while data := response.read1(_CHUNK_BYTES):
            taken_s = time.monotonic()
            for part in parser.feed(data):
                yield frame_of(part, taken_s, self._address)

    def _pictures(self, response: HTTPResponse, known: Credentials | None) -> Iterator[Frame]:
        period_s = 1 / self._options.rate_hz
        while True:
            taken_s = time.monotonic()
            content = response.read(MAX_CONTENT_BYTES + 1)
            if len(content) > MAX_CONTENT_BYTES:
                raise SensorError(
                    f"{shown(self._address)}: a picture has more than {MAX_CONTENT_BYTES // 1000} KB; choose a lower "
                    "resolution or quality in the camera"
                )
            self._client.close()
            yield frame_of(content, taken_s, self._address)
            if self._aborted.wait(max(0.0, taken_s + period_s - time.monotonic())):
                return
            response = self._client.open(self._address, known)


def frame_of(jpeg: bytes, taken_s: float, address: SplitResult) -> Frame:
    """A frame from received data.

    Raises:
        SensorError: The data is no JPEG.
    """
    try:
        width, height = jpeg_size(jpeg)
    except ValueError as error:
        raise SensorError(
            f"{shown(address)} sends no JPEG; check that option 'url' is the address of its MJPEG stream or picture"
        ) from error
    return Frame(width, height, jpeg, taken_s)


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:  # noqa: ARG001
    """The driver of one camera: the factory of ``sensors.load("mjpeg")``.

    Raises:
        SensorError: An option is unknown, missing or wrong.
    """
    options = with_files(parse(device.options, Options, driver="mjpeg", device=device.name), folder)
    return CameraDriver(device, MjpegSource(options), options)

"""Cameras that stream over RTSP, with H.264, H.265 or JPEG. FFmpeg decodes them in a process of its own."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from msgspec import Meta

from device_agent.ports.sensor import RoomDriver, Surroundings
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.camera.decoder_process import DecoderSource
from device_agent.sensors.camera.driver import CameraDriver
from device_agent.sensors.camera.options import NetworkCamera, credentials, parse, shown, split_address, with_files

_PORT = 554


class Options(NetworkCamera, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver ``rtsp``.

    Attributes:
        width: Maximum width of published pictures [pixels]. Larger ones are reduced.
    """

    width: Annotated[int, Meta(ge=64, le=1920)] = 640


def _reasons(where: str) -> Mapping[str, str]:
    return {
        "crashed": f"the decoder of {where} has crashed; the agent starts it again. If it remains, use another codec",
        "ended": f"{where} has ended the stream; the agent connects again",
        "invalid": f"{where} sends no valid RTSP stream; check option 'url' and the codec in the camera",
        "library": "driver 'rtsp' needs the package av; install it with `pip install telescope-agent[camera]`",
        "no-video": f"{where} has no video; check the path in option 'url'",
        "not-found": f"{where} has no such stream; check the path in option 'url'",
        "oversized": f"{where} has too large pictures; choose a lower resolution in the camera, or a smaller 'width'",
        "rejected": f"{where} does not accept user and password; check the device's options",
        "timeout": f"{where} does not respond; check that the camera has power and is connected",
        "unreachable": f"{where} cannot be reached; check that the camera has power, and its address",
    }


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:  # noqa: ARG001
    """The driver of one camera: the factory of ``sensors.load("rtsp")``.

    Raises:
        SensorError: An option is unknown, missing or wrong.
    """
    options = with_files(parse(device.options, Options, driver="rtsp", device=device.name), folder)
    address = split_address(options.url, ("rtsp",))

    def settings() -> Mapping[str, Any]:
        known = credentials(options)
        login = "" if known is None else f"{quote(known.user, safe='')}:{quote(known.password, safe='')}@"
        port = address.port or _PORT
        # The decoder looks the host up before it confines itself, and then inserts its address.
        rest = address._replace(scheme="", netloc="", fragment="").geturl().replace("{", "%7B").replace("}", "%7D")
        return {
            "source": "rtsp",
            "url": f"rtsp://{login}{{host}}:{port}{rest}",
            "host": address.hostname,
            "port": port,
            "rate_hz": options.rate_hz,
            "timeout_s": options.stale_s,
            "width": options.width,
        }

    return CameraDriver(device, DecoderSource(settings, _reasons(shown(address))), options)

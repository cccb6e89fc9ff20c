"""Cameras of this machine, such as USB cameras, through Video4Linux. OpenCV reads them in a process of its own."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from device_agent.ports.sensor import RoomDriver, Surroundings
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.camera.decoder_process import DecoderSource
from device_agent.sensors.camera.driver import CameraDriver
from device_agent.sensors.camera.options import Timing, parse


class Options(Timing, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver ``v4l2``.

    Attributes:
        device: Path of the camera. A path in ``/dev/v4l/by-id`` stays the same when cameras are plugged in again.
        width: Requested width [pixels]; the camera chooses the nearest that it supports.
        height: Requested height [pixels].
    """

    device: Annotated[str, Meta(pattern=r"^/")] = "/dev/video0"
    width: Annotated[int, Meta(ge=64, le=1920)] = 640
    height: Annotated[int, Meta(ge=48, le=1080)] = 480


def _reasons(where: str) -> Mapping[str, str]:
    return {
        "busy": f"{where} cannot be opened; check that no other program uses the camera",
        "crashed": f"the decoder of {where} has crashed; the agent starts it again. Plug the camera in again",
        "denied": f"{where}: no permission; add the agent's user to the group video, and "
        "allow the service to use cameras as the guide for room cameras describes",
        "library": "driver 'v4l2' needs the package opencv-python-headless; install it with "
        "`pip install telescope-agent[camera]`",
        "missing": f"{where} does not exist; check that the camera is plugged in, and option 'device'",
        "no-capture": f"{where} is not a camera; list the cameras with `ls /dev/v4l/by-id`",
        "oversized": f"{where} has too large pictures; choose a smaller 'width' and 'height'",
        "timeout": f"{where} sends no pictures; plug the camera in again",
    }


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:  # noqa: ARG001
    """The driver of one camera: the factory of ``sensors.load("v4l2")``.

    Raises:
        SensorError: An option is unknown, missing or wrong.
    """
    options = parse(device.options, Options, driver="v4l2", device=device.name)
    settings = {
        "source": "v4l2",
        "device": options.device,
        "width": options.width,
        "height": options.height,
        "rate_hz": options.rate_hz,
        "timeout_s": options.stale_s,
    }
    return CameraDriver(device, DecoderSource(lambda: settings, _reasons(options.device)), options)

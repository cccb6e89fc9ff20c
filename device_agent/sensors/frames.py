"""Frames of depth and people for viewers, and checks of the kinds that a driver can supply."""

from collections.abc import Collection, Sequence

import msgspec
import numpy as np

from device_agent.ports.sensor import Capture, Depths, Floats, Frame, Image, SensorError, rounded, rounded_rows
from device_agent.protocol import CameraStream, TrackedPeople, TrackedPerson, camera_frames
from device_agent.protocol.camera_frames import MAX_CONTENT_BYTES
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.protocol.telemetry import MAX_PEOPLE
from device_agent.sensors import png

_MILLIMETRE = 0.001
_FAR_MM = 65_535


def declared_camera(device: RoomDeviceManifest, camera: str) -> CameraStream:
    """The stream of frames of this name in the manifest.

    Raises:
        SensorError: There is none; the message lists the names.
    """
    declared = {known.name: known for known in device.cameras}
    if camera not in declared:
        names = ", ".join(declared) or "none"
        raise SensorError(f"'{device.name}' has no camera '{camera[:80]}'; it has: {names}")
    return declared[camera]


def check_kinds(device: RoomDeviceManifest, kinds: Collection[str]) -> None:
    """Check that a driver can supply the kinds of all frames that the manifest declares.

    Raises:
        SensorError: It cannot; the message names the camera and the possible kinds.
    """
    for camera in device.cameras:
        if camera.kind not in kinds:
            raise SensorError(
                f"camera '{camera.name}' of '{device.name}' has the kind '{camera.kind}'; a {device.kind} with driver "
                f"'{device.driver}' has: {', '.join(kinds) or 'no cameras'}"
            )


def depth_capture(depth_m: Depths) -> Capture:
    """A depth image as a 16-bit PNG in millimetres, 0 without an echo, at full resolution."""
    return Capture("image/png", _encode(depth_m))


def depth_frame(image: Image) -> Frame:
    """A depth image for viewers, in the format of ``depth_capture``.

    An image that exceeds the maximum message size is reduced to every second pixel, repeatedly. The remaining pixels
    are exact: averages would invent distances between near and far surfaces.

    Raises:
        SensorError: The image has no depth.
    """
    if image.depth_m is None:
        raise SensorError("the image has no depth")
    step, content = 1, _encode(image.depth_m)
    while len(content) > MAX_CONTENT_BYTES:
        step *= 2
        content = _encode(image.depth_m[::step, ::step])
    height, width = image.depth_m[::step, ::step].shape
    return Frame(width, height, content, image.taken_s, camera_frames.DEPTH)


def people_frame(
    people: Sequence[TrackedPerson], *, taken_s: float, position_m: Floats, rotation: Floats, fovy_rad: float
) -> Frame:
    """The first ``MAX_PEOPLE`` tracked people, with pose and vertical field of view [rad] of their camera."""
    message = TrackedPeople(
        position_m=rounded(position_m),
        rotation=rounded_rows(rotation),
        fovy_rad=fovy_rad,
        people=tuple(people[:MAX_PEOPLE]),
    )
    return Frame(len(message.people), 1, msgspec.json.encode(message), taken_s, camera_frames.PEOPLE)


def _encode(depth_m: Depths) -> bytes:
    millimetres = np.rint(np.nan_to_num(depth_m, posinf=0.0) / _MILLIMETRE)
    return png.encode(np.clip(millimetres, 0, _FAR_MM).astype(np.uint16))

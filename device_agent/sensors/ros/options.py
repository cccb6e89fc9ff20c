"""Options of a sensor with ROS: ``options`` of the room's manifest."""

import math
from typing import Annotated

import msgspec
from msgspec import Meta

from device_agent.middleware.ros.endpoint import Endpoint
from device_agent.ports.sensor import SensorError
from device_agent.protocol.manifests.room import RoomDeviceManifest

Angle = Annotated[float, Meta(ge=-2 * math.pi, le=2 * math.pi)]


class Options(Endpoint, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All options, with those of ``Endpoint``.

    Attributes:
        topic: Topic of the measurements.
        rotation_rad: Mounting of the sensor in the room: turns about the room's x, y and z axes, in this order [rad].
            Without turns a lidar's first axis and a camera's right side are the room's x axis.
        fovy_rad: Vertical field of view of a camera [rad].
    """

    topic: Annotated[str, Meta(pattern=r"^[/~A-Za-z][A-Za-z0-9_/]*$", max_length=200)]
    rotation_rad: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    fovy_rad: Annotated[float, Meta(gt=0, lt=math.pi)] = 0.8


def parse(device: RoomDeviceManifest) -> Options:
    """The options of one device.

    Raises:
        SensorError: An option is unknown, missing or wrong; the message lists the valid ones.
    """
    try:
        options = msgspec.convert(device.options, Options)
    except msgspec.ValidationError as error:
        valid = ", ".join(Options.__struct_fields__)
        raise SensorError(f"options of '{device.name}': {error}; valid options: {valid}") from error
    if options.contradiction:
        raise SensorError(f"options of '{device.name}': {options.contradiction}")
    return options

"""Driver plug-in for the template's device. ``new-driver`` copies this package."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.testing.template.driver import TemplateDriver
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType

OPTIONS = ("address",)


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> TemplateDriver:
    """The driver of one device: the entry point of the group ``telescope.drivers``. It opens no connection.

    Options (text):
        address: ``host:port`` of the device.

    Raises:
        DriverError: An option is unknown, missing or wrong.
    """
    for name in options:
        if name not in OPTIONS:
            raise DriverError(f"driver 'template' has no option '{name}'; it has: {', '.join(OPTIONS)}")
    host, _, port = str(options.get("address", "")).rpartition(":")
    if not host or not port.isdecimal():
        raise DriverError("option 'address' of driver 'template' must be host:port")
    return TemplateDriver(robot_type, folder, (host, int(port)), device)

"""Driver of NAO robots over NAOqi. The library ``qi`` runs in a process of its own: ``bridge.py``."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.naoqi.driver import NaoqiDriver
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType

OPTIONS = ("address", "python")
_PORT = 9559


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> NaoqiDriver:
    """The driver of one NAO: the factory of ``drivers.load("naoqi")``. It opens no connection.

    Options (text):
        address: ``host`` or ``host:port`` of NAOqi; the port is 9559 by default.
        python: Path of a Python interpreter that has the package ``qi``.

    Raises:
        DriverError: An option is unknown, missing or wrong.
    """
    for name in options:
        if name not in OPTIONS:
            raise DriverError(f"driver 'naoqi' has no option '{name}'; it has: {', '.join(OPTIONS)}")
    host, _, port = str(options.get("address", "")).partition(":")
    if not host or not (port or str(_PORT)).isdecimal():
        raise DriverError("option 'address' of driver 'naoqi' must be host or host:port")
    python = options.get("python")
    if not isinstance(python, str) or not python:
        raise DriverError("option 'python' of driver 'naoqi' must be the path of a Python that has the package qi")
    return NaoqiDriver(robot_type, folder, url=f"tcp://{host}:{port or _PORT}", python=python, device=device)

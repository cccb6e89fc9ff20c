"""Driver of LeRobot's robots. The library ``lerobot`` runs in a process of its own: ``bridge.py``."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.lerobot.driver import LerobotDriver, LerobotMobileDriver
from device_agent.drivers.lerobot.robots import ROBOTS
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType

OPTIONS = ("robot", "port", "id", "calibration", "python")


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> LerobotDriver:
    """The driver of one robot: the factory of ``drivers.load("lerobot")``. It opens no connection.

    Options (text):
        robot: LeRobot's name of the robot, one of ``ROBOTS``.
        port: Serial port of the servos, such as ``/dev/serial/by-id/…``.
        id: Name of the calibration, as for ``lerobot-calibrate``.
        calibration: Folder of the calibration file; LeRobot's own by default.
        python: Path of a Python interpreter that has the package ``lerobot``.

    Raises:
        DriverError: An option is unknown, missing or wrong.
    """
    for name, value in options.items():
        if name not in OPTIONS:
            raise DriverError(f"driver 'lerobot' has no option '{name}'; it has: {', '.join(OPTIONS)}")
        if not isinstance(value, str) or not value:
            raise DriverError(f"option '{name}' of driver 'lerobot' must be a text")
    for name in OPTIONS:
        if name not in options and name != "calibration":
            raise DriverError(f"driver 'lerobot' needs the option '{name}'")
    if options["robot"] not in ROBOTS:
        raise DriverError(f"driver 'lerobot' has no robot '{options['robot']}'; it has: {', '.join(ROBOTS)}")
    driver = LerobotDriver if robot_type.base is None else LerobotMobileDriver
    return driver(robot_type, folder, options={name: str(value) for name, value in options.items()}, device=device)

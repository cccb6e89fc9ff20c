"""Driver of Universal Robots' arms (CB3 and e-Series) over RTDE. See ``docs/robots/universal-robots.md``."""

import re
from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.ur.driver import ORDER, Controller, UrDriver
from device_agent.drivers.ur.outputs import OUTPUTS
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType

__all__ = ["Controller", "UrDriver", "create"]

_MAX_FREQUENCY_HZ = 500
_MAX_PORT = 65535
_PROGRAM = re.compile(r"[\w./ +-]{1,190}\.urp")
"""A path; without control characters, which would be further commands."""
_DEFAULTS = {"frequency": 125, "rtde_port": 30004, "script_port": 30002, "dashboard_port": 29999}
_OPTIONS = ("address", *_DEFAULTS, "programs", "outputs", "gripper_port")


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> UrDriver:
    """The driver of one arm: the factory of ``drivers.load("ur")``. It opens no connection.

    Options:
        address: Host name or IP address of the controller. Required.
        frequency: Measurements per second [Hz], 1 to 500; 125. A CB3 controller sends at most 125.
        rtde_port: Port of RTDE; 30004.
        script_port: Port of the secondary interface; 30002.
        dashboard_port: Port of the dashboard server; 29999.
        outputs: Digital outputs that operators may set, as a list of names of ``outputs.OUTPUTS``; none.
        gripper_port: Port of the URCap of a two-finger gripper of Robotiq, 63352; none.
        programs: Programs on the controller that operators may run, as a list of paths; none.

    Raises:
        DriverError: An option is unknown, missing or wrong, or the robot type is not an arm of this manufacturer.
    """
    for name in options:
        if name not in _OPTIONS:
            raise DriverError(f"driver 'ur' has no option '{name}'; it has: {', '.join(_OPTIONS)}")
    address = options.get("address")
    if not isinstance(address, str) or not address:
        raise DriverError("option 'address' of driver 'ur' must be the host name or IP address of the controller")
    names = [joint.name for joint in robot_type.joints]
    if sorted(names) != sorted(ORDER):
        raise DriverError(f"robot type '{robot_type.type}' must have the joints {', '.join(ORDER)} for driver 'ur'")
    controller = Controller(
        host=address,
        rtde_port=_number(options, "rtde_port", _MAX_PORT),
        script_port=_number(options, "script_port", _MAX_PORT),
        frequency_hz=_number(options, "frequency", _MAX_FREQUENCY_HZ),
        dashboard_port=_number(options, "dashboard_port", _MAX_PORT),
        programs=_programs(options),
        outputs=_outputs(options),
        gripper_port=_number(options, "gripper_port", _MAX_PORT) if "gripper_port" in options else 0,
    )
    return UrDriver(robot_type, folder, controller, device)


def _number(options: Mapping[str, object], name: str, maximum: int) -> int:
    value = options.get(name, _DEFAULTS.get(name))
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= maximum:
        raise DriverError(f"option '{name}' of driver 'ur' must be a whole number from 1 to {maximum}, not {value!r}")
    return value


def _programs(options: Mapping[str, object]) -> tuple[str, ...]:
    paths = options.get("programs", [])
    if not isinstance(paths, list) or not all(isinstance(path, str) and _PROGRAM.fullmatch(path) for path in paths):
        raise DriverError("option 'programs' of driver 'ur' must be a list of paths that end with .urp")
    return tuple(dict.fromkeys(paths))


def _outputs(options: Mapping[str, object]) -> tuple[str, ...]:
    names = options.get("outputs", [])
    if not isinstance(names, list) or not all(name in OUTPUTS for name in names):
        raise DriverError(f"option 'outputs' of driver 'ur' must be a list of: {', '.join(OUTPUTS)}")
    return tuple(dict.fromkeys(names))

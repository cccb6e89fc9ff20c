"""Driver of NAO robots over NAOqi. The library ``qi`` runs in a process of its own: ``bridge.py``."""

from collections.abc import Mapping
from pathlib import Path

from device_agent.drivers.naoqi.driver import NaoqiDriver
from device_agent.drivers.naoqi.scripts import LegacyScripts
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType

OPTIONS = ("address", "python", "behaviours", "legacy_scripts", "scripts", "script_python")
_PORT = 9559


def create(robot_type: RobotType, folder: Path, options: Mapping[str, object], device: str) -> NaoqiDriver:
    """The driver of one NAO: the factory of ``drivers.load("naoqi")``. It opens no connection.

    Options:
        address: ``host`` or ``host:port`` of NAOqi; the port is 9559 by default.
        python: Path of a Python interpreter that has the package ``qi``.
        behaviours: Installed behaviours that operators may run, as a list of patterns; ``["*"]``.
        legacy_scripts: The owner's permission to run Python programs for NAOqi; false.
        scripts: Folder of these programs, which only the agent's user may write.
        script_python: Interpreter that runs them; ``python`` by default.

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
    patterns = options.get("behaviours", ["*"])
    if not isinstance(patterns, list) or not all(isinstance(pattern, str) for pattern in patterns):
        raise DriverError("option 'behaviours' of driver 'naoqi' must be a list of texts, such as [\"animations/*\"]")
    return NaoqiDriver(
        robot_type,
        folder,
        url=f"tcp://{host}:{port or _PORT}",
        python=python,
        device=device,
        patterns=patterns,
        scripts=_scripts(options, python),
    )


def _scripts(options: Mapping[str, object], python: str) -> LegacyScripts:
    """The scripts that the owner permits."""
    permitted, folder = options.get("legacy_scripts", False), options.get("scripts", "")
    interpreter = options.get("script_python", python)
    if not isinstance(permitted, bool):
        raise DriverError("option 'legacy_scripts' of driver 'naoqi' must be true or false")
    if not isinstance(folder, str) or not isinstance(interpreter, str) or not interpreter:
        raise DriverError("options 'scripts' and 'script_python' of driver 'naoqi' must be paths")
    if permitted != bool(folder):
        raise DriverError(
            "options 'legacy_scripts' and 'scripts' of driver 'naoqi' belong together: legacy_scripts = true is the "
            "owner's permission to run the programs in the folder 'scripts'"
        )
    return LegacyScripts(Path(folder) if permitted else None, interpreter)

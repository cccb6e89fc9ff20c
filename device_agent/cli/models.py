"""``import-model``: create a robot type from a MuJoCo model."""

import argparse
import sys
from pathlib import Path

from device_agent import drivers, geometry
from device_agent.cli.arguments import Commands
from device_agent.config import catalogue
from device_agent.config.errors import ConfigError
from device_agent.ports.driver import DriverError
from device_agent.ports.geometry import GeometryError


def add_commands(commands: Commands, _home: Path) -> None:
    """Add ``import-model``."""
    parser = commands.add_parser("import-model", help="create a robot type folder from a MuJoCo model")
    parser.add_argument("model", type=Path, help="MJCF file of the robot, alone or in a scene")
    parser.add_argument("--name", required=True, help="name of the new robot type")
    parser.add_argument(
        "--into", type=Path, default=Path(), metavar="FOLDER", help="parent folder (default: the current folder)"
    )
    parser.add_argument(
        "--without", action="append", default=[], metavar="ACTUATOR", help="omit this actuator; may be repeated"
    )
    parser.set_defaults(command=_import_model)


def _import_model(options: argparse.Namespace) -> int:
    # Imported here: agents of real robots may have no MuJoCo.
    from device_agent.simulation.mjcf.import_model import ImportModelError, import_model  # noqa: PLC0415

    try:
        folder = import_model(options.model, options.name, options.into, without=options.without)
    except ImportModelError as error:
        raise ConfigError(str(error)) from error
    print(f"created {folder.resolve()}; check the values that its robot.toml marks as guessed")
    try:
        _check_robot_type(folder)
    except (ConfigError, DriverError, GeometryError) as error:
        print(f"the robot type does not run yet: {error}", file=sys.stderr)
        return 1
    print(f"the robot type runs; add {folder.resolve().parent} to {catalogue.ROBOTS_PATH} to use it")
    return 0


def _check_robot_type(folder: Path) -> None:
    """Load a robot type and connect its simulated driver once.

    Raises:
        ConfigError: The manifest is wrong.
        GeometryError: The model cannot be used, or the home position collides.
        DriverError: The driver rejects the robot type.
    """
    kind = catalogue.TYPES.load_from(folder)
    geometry.load(kind, folder)
    driver = drivers.load("mujoco")(kind, folder, {}, kind.type)
    driver.connect()
    driver.close()

"""``new-driver``: create a driver package that passes the driver contract, to be adapted to a device."""

import argparse
import re
from importlib import resources
from pathlib import Path

from device_agent import drivers
from device_agent.cli.arguments import Commands
from device_agent.config import catalogue
from device_agent.config.errors import ConfigError

_TYPES = {"arm": "ur5", "base": "qbo"}
_SOURCES = ("__init__.py", "connection.py", "driver.py", "base_driver.py")
_TESTS = ("peer.py", "test_driver.py")
_TEMPLATE = "device_agent.drivers.testing.template"

_PROJECT = """\
[project]
name = "telescope-{name}"
version = "0.1.0"
description = "Telescope driver '{name}'"
requires-python = ">=3.11"

[project.optional-dependencies]
test = ["pytest>=8"]

[project.entry-points."telescope.drivers"]
{name} = "{package}:create"

[build-system]
requires = ["uv_build"]
build-backend = "uv_build"

[tool.uv.build-backend]
module-name = "{package}"
module-root = ""

[tool.pytest.ini_options]
testpaths = ["tests"]
pythonpath = [".", "tests"]
"""

_README = """\
# Telescope driver `{name}`

1. Install `telescope-agent[sim]` and `pytest`, and run `python -m pytest`. The contract suite passes with the emulated
   device in `tests/peer.py`.
2. Replace the protocol in `{package}/connection.py` and in `tests/peer.py` by that of your device.
3. Set the robot type in `tests/test_driver.py` to yours. Add its folder to `TELESCOPE_ROBOTS_PATH`.
4. Run the tests until they pass, then test slowly at the real device, with its emergency stop in reach.
5. Install this package next to the agent, and select the driver in `agent.toml`:

```toml
[[devices]]
name = "robot"
type = "{type}"
driver = "{name}"

[devices.options]
address = "192.168.0.10:5000"
```

The page "Write a driver" of Telescope's documentation describes the contract.
"""


def add_commands(commands: Commands, _home: Path) -> None:
    """Add ``new-driver``."""
    parser = commands.add_parser("new-driver", help="create a package for a driver of your own")
    parser.add_argument("name", help="name of the driver, as in agent.toml")
    parser.add_argument("--kind", choices=sorted(_TYPES), default="arm", help="base: with a mobile base (default: arm)")
    parser.add_argument("--type", help="robot type for the tests (default: ur5, or qbo for a base)")
    parser.add_argument(
        "--into", type=Path, default=Path(), metavar="FOLDER", help="parent folder (default: the current folder)"
    )
    parser.set_defaults(command=_new_driver)


def _new_driver(options: argparse.Namespace) -> int:
    name, folder = options.name, options.into / f"telescope-{options.name}"
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        raise ConfigError(f"'{name}' is not a driver name: use lower-case letters, digits and single hyphens")
    if name in drivers.names():
        raise ConfigError(f"there is a driver '{name}' already; choose another name")
    robot_type = catalogue.TYPES.load(options.type or _TYPES[options.kind])
    if (robot_type.base is None) == (options.kind == "base"):
        other = "no base" if robot_type.base is None else "a base"
        raise ConfigError(f"robot type '{robot_type.type}' has {other}; choose another --type or --kind")
    if folder.exists():
        raise ConfigError(f"{folder} exists already")
    package = "telescope_" + name.replace("-", "_")
    texts = {"name": name, "package": package, "type": robot_type.type}
    _write(folder / "pyproject.toml", _PROJECT.format_map(texts))
    _write(folder / "README.md", _README.format_map(texts))
    for target, files in ((package, _SOURCES), ("tests", _TESTS)):
        for file in files:
            if file != "base_driver.py" or options.kind == "base":
                _write(folder / target / file, _adapt(file, name, package, options.kind, robot_type.type))
    print(f"created {folder.resolve()}; run its tests with: cd {folder.resolve()} && python -m pytest")
    return 0


def _adapt(file: str, name: str, package: str, kind: str, robot_type: str) -> str:
    """A file of the template with the names of the new package."""
    source = resources.files("device_agent") / "drivers" / "testing" / "template" / file
    text = source.read_text(encoding="utf-8")
    if kind == "base" and file in {"__init__.py", "test_driver.py"}:
        text = text.replace(f"{_TEMPLATE}.driver", f"{_TEMPLATE}.base_driver")
        text = re.sub(r"\bTemplateDriver\b", "TemplateBaseDriver", text)
    text = text.replace(f"{_TEMPLATE}.peer", "peer").replace(_TEMPLATE, package)
    text = text.replace(" ``new-driver`` copies this package.", "").replace("the template's device", "the device")
    text = text.replace("'template'", f"'{name}'").replace('"ur5"', f'"{robot_type}"')
    return text.replace("Template", "".join(part.capitalize() for part in name.split("-")))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")

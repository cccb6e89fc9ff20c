"""Checks of the devices: drivers, models and rendering."""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from device_agent import bootstrap
from device_agent.cli.doctor.finding import Finding, ok, problem, warning
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.ports.driver import DriverError
from device_agent.ports.geometry import GeometryError
from device_agent.ports.sensor import SensorError
from device_agent.runtime.room.room_device import RoomDevice

_ROOT = Path(__file__).resolve().parents[3]
_RENDER_S = 60.0
_RENDER = """
import mujoco
from device_agent.simulation import offscreen
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>')
backend = offscreen.select()
backend.create(64, 48).make_current()
mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
print(backend.name)
"""


def device(entry: DeviceEntry, home: Path) -> Iterator[Finding]:
    """Check type, model and driver. Builds a simulated device; does not touch a real one, which may be in use.

    Args:
        entry: The device.
        home: The agent's folder.
    """
    name = f"device {entry.name}"
    try:
        kind = catalogue.type_of(entry)
        room_device = bootstrap.create_room_device(entry, {}, home=home)
        if room_device is not None:
            yield _room_device(name, kind.type, room_device)
            return
        shape = bootstrap.load_geometry(entry, kind)
        driver = bootstrap.create_driver(entry, kind)
        if driver.simulated:
            driver.connect()
            driver.close()
    except ConfigError as error:
        yield problem(name, str(error), "Correct the device in agent.toml, or install what its driver needs.")
        return
    except (DriverError, GeometryError) as error:
        yield problem(name, str(error), "Correct the device in agent.toml, or install what its driver needs.")
        return
    geometry = "its shape is known" if shape is not None else "its shape is unknown, so self-collision is not checked"
    checked = "simulated; its model compiles" if driver.simulated else "real; not touched by this check"
    yield ok(name, f"{entry.type}, driver '{entry.driver or kind.driver}': {checked}, {geometry}")


def _room_device(name: str, kind: str, room_device: RoomDevice) -> Finding:
    """Check a room device. Devices that depend on other devices are created, but not run."""
    driver, summary = room_device.driver, f"{kind}, driver '{room_device.manifest.driver}'"
    if not driver.simulated:
        return ok(name, f"{summary}: real; not touched by this check")
    try:
        driver.connect()
        driver.close()
    except SensorError as error:
        return problem(name, str(error), "Correct the device in the room's manifest, or in agent.toml.")
    return ok(name, f"{summary}: simulated; its room has what it needs")


def room(configuration: AgentConfig) -> Iterator[Finding]:
    """Check that the measurements for interlocks and scripts can be received."""
    own = {entry.name for entry in configuration.devices}
    others = [f"{source}/{stream}" for source, stream in configuration.room_sources if source not in own]
    if others and configuration.transport != "mqtt":
        yield problem(
            "room",
            f"over {configuration.transport} an agent receives no measurements of other agents: {', '.join(others)}; "
            "an interlock without measurements holds its robot",
            'Use `transport = "mqtt"` in agent.toml, or connect the sensor to this agent.',
        )


def renderer(configuration: AgentConfig) -> Iterator[Finding]:
    """Check that MuJoCo can render, in a separate process: a wrong library can abort the process."""
    if not bootstrap.simulates(configuration) or importlib.util.find_spec("mujoco") is None:
        return
    if name := _renders():
        yield ok("renderer", f"{name} renders simulated cameras")
        return
    requested = os.environ.get("MUJOCO_GL", "")
    unset = f"Unset MUJOCO_GL (now {requested}), or install" if requested else "Install"
    yield warning(
        "renderer",
        "simulated cameras provide no images; everything else works",
        f"{unset} a software renderer (Debian: apt-get install libosmesa6).",
    )


def _renders() -> str:
    """Name of the library that renders in a child process, empty if none does."""
    try:
        completed = subprocess.run(  # noqa: S603 (a constant script, run by this interpreter)
            [sys.executable, "-c", _RENDER],
            env=os.environ | {"PYTHONPATH": str(_ROOT)},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_RENDER_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return completed.stdout.strip() if completed.returncode == 0 else ""

"""Checks of the devices: drivers, models and rendering."""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping

from device_agent import bootstrap
from device_agent.cli.doctor.finding import Finding, ok, problem, warning
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.ports.driver import DriverError
from device_agent.ports.geometry import GeometryError
from device_agent.ports.sensor import SensorError
from device_agent.runtime.room.room_device import RoomDevice

_RENDER_S = 60.0
_RENDER = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light pos="0 0 3"/><geom size=".1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    assert renderer.render().any()
"""
_SOFTWARE = {"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"}


def device(entry: DeviceEntry) -> Iterator[Finding]:
    """Check type, model and driver. Builds a simulated device; does not touch a real one, which may be in use."""
    name = f"device {entry.name}"
    try:
        kind = catalogue.type_of(entry)
        room_device = bootstrap.create_room_device(entry, {})
        if room_device is not None:
            yield _room_device(name, kind.type, room_device)
            return
        shape = bootstrap.load_geometry(entry, kind)
        driver = bootstrap.create_driver(entry, kind)
        if driver.simulated:
            driver.connect()
            driver.close()
    except ConfigError as error:
        yield problem(name, str(error), "Correct the device's `type` or `room` in agent.toml.")
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
    """Check that MuJoCo can render, in a separate process: without a renderer its libraries abort the process."""
    used = {entry.driver or _driver_of(entry) for entry in configuration.devices}
    if "mujoco" not in used or importlib.util.find_spec("mujoco") is None:
        return
    chosen = os.environ.get("MUJOCO_GL", "")
    if _renders({}):
        yield ok("renderer", f"images can be rendered (MUJOCO_GL={chosen or 'not set'})")
    elif _renders(_SOFTWARE):
        settings = " ".join(f"{name}={value}" for name, value in _SOFTWARE.items())
        message = f"images cannot be rendered with MUJOCO_GL={chosen or 'not set'}, but with {settings}"
        yield warning("renderer", message, f"Set {settings} in the environment of the agent.")
    else:
        yield warning(
            "renderer",
            "simulated cameras provide no images; everything else works",
            "Install a software renderer (Debian: apt-get install libosmesa6) and set MUJOCO_GL=osmesa.",
        )


def _driver_of(entry: DeviceEntry) -> str:
    try:
        return catalogue.type_of(entry).driver
    except ConfigError:
        return ""


def _renders(changes: Mapping[str, str]) -> bool:
    try:
        completed = subprocess.run(  # noqa: S603 (a constant script, run by this interpreter)
            [sys.executable, "-I", "-c", _RENDER],
            env={**os.environ, **changes},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_RENDER_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return completed.returncode == 0

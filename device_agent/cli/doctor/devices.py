"""The devices: whether each one's driver and model can be loaded, and whether pictures can be drawn."""

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
    """Its type, model and driver. A simulated one is built; a real one is left alone, for it may be at work."""
    name = f"device {entry.name}"
    try:
        kind = catalogue.type_of(entry)
        instrument = bootstrap.instrument_of(entry, {})
        if instrument is not None:
            yield _instrument(name, kind.type, instrument)
            return
        shape = bootstrap.geometry_of(entry, kind)
        driver = bootstrap.driver_of(entry, kind)
        if driver.simulated:
            driver.connect()
            driver.close()
    except ConfigError as error:
        yield problem(name, str(error), "Correct the device's `type` or `room` in agent.toml.")
        return
    except (DriverError, GeometryError) as error:
        yield problem(name, str(error), "Correct the device in agent.toml, or install what its driver needs.")
        return
    known = "its shape is known" if shape is not None else "its shape is not known, so it is not kept from itself"
    seen = "simulated; its model compiles" if driver.simulated else "real; not touched by this check"
    yield ok(name, f"{entry.type}, driver '{entry.driver or kind.driver}': {seen}, {known}")


def _instrument(name: str, kind: str, instrument: RoomDevice) -> Finding:
    """A room device; one that looks with others is only made, for here it is alone."""
    driver, said = instrument.driver, f"{kind}, driver '{instrument.manifest.driver}'"
    if not driver.simulated:
        return ok(name, f"{said}: real; not touched by this check")
    try:
        driver.connect()
        driver.close()
    except SensorError as error:
        return problem(name, str(error), "Correct the device in the room's manifest, or in agent.toml.")
    return ok(name, f"{said}: simulated; its room has what it needs")


def room(configuration: AgentConfig) -> Iterator[Finding]:
    """Whether what interlocks and movements listen to can be heard."""
    own = {entry.name for entry in configuration.devices}
    others = [f"{source}/{stream}" for source, stream in configuration.room_sources if source not in own]
    if others and configuration.transport != "mqtt":
        yield problem(
            "room",
            f"over {configuration.transport} an agent hears nothing of other agents: {', '.join(others)} stays silent, "
            "and an interlock that hears nothing holds its robot",
            'Use `transport = "mqtt"` in agent.toml, or connect the sensor to this agent.',
        )


def renderer(configuration: AgentConfig) -> Iterator[Finding]:
    """Whether MuJoCo can draw pictures. In a process of its own: without a renderer its libraries end the process."""
    used = {entry.driver or _driver_of(entry) for entry in configuration.devices}
    if "mujoco" not in used or importlib.util.find_spec("mujoco") is None:
        return
    chosen = os.environ.get("MUJOCO_GL", "")
    if _renders({}):
        yield ok("renderer", f"pictures can be drawn (MUJOCO_GL={chosen or 'not set'})")
    elif _renders(_SOFTWARE):
        wanted = " ".join(f"{name}={value}" for name, value in _SOFTWARE.items())
        said = f"no picture can be drawn with MUJOCO_GL={chosen or 'not set'}, but with {wanted}"
        yield warning("renderer", said, f"Set {wanted} where the agent is started.")
    else:
        yield warning(
            "renderer",
            "simulated cameras give no pictures; all else works",
            "Install a software renderer (Debian: apt-get install libosmesa6) and set MUJOCO_GL=osmesa.",
        )


def _driver_of(entry: DeviceEntry) -> str:
    try:
        return catalogue.type_of(entry).driver
    except ConfigError:
        return ""


def _renders(changes: Mapping[str, str]) -> bool:
    try:
        done = subprocess.run(  # noqa: S603 (our own lines, run by our own interpreter)
            [sys.executable, "-I", "-c", _RENDER],
            env={**os.environ, **changes},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_RENDER_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0

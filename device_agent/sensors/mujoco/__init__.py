"""Room devices in a simulated room, with realistic sensor errors."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import msgspec

from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.ports.simulation import SimulatedWorld
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.mujoco.base import SimulatedSensor
from device_agent.sensors.mujoco.cameras import ColourCamera, DepthCamera
from device_agent.sensors.mujoco.fault_injection import with_faults
from device_agent.sensors.mujoco.lidar import Lidar
from device_agent.sensors.mujoco.pir import Pir
from device_agent.sensors.mujoco.scalar_sensors import Contact, Meter

__all__ = ["FAULTS", "KINDS", "create"]

FAULTS = "faults"

KINDS: Mapping[str, Callable[[RoomDeviceManifest, SimulatedWorld], SimulatedSensor]] = {
    "camera": ColourCamera,
    "depth_camera": DepthCamera,
    "lidar": Lidar,
    "pir": Pir,
    "thermometer": partial(Meter, quantity="temperature_c"),
    "hygrometer": partial(Meter, quantity="humidity_percent"),
    "co2_meter": partial(Meter, quantity="co2_ppm"),
    "light_meter": partial(Meter, quantity="light_lux"),
    "sound_meter": partial(Meter, quantity="sound_db"),
    "door_contact": Contact,
    "lamp": SimulatedSensor,
    "door": SimulatedSensor,
    "blinds": SimulatedSensor,
    "thermostat": SimulatedSensor,
}
"""``kind`` of the manifest → driver class."""


def create(device: RoomDeviceManifest, folder: Path, surroundings: Surroundings) -> RoomDriver:
    """The driver of one device: the factory of ``sensors.load("mujoco")``.

    Every kind has the option ``faults``: a file of injected faults, relative to the room's folder, which may appear and
    disappear at runtime (see ``fault_injection``).

    Raises:
        SensorError: Unknown kind or option, or the room is not simulated.
    """
    if surroundings.world is None:
        raise SensorError(f"'{device.name}' is a simulated device, but its room has no model")
    if device.kind not in KINDS:
        raise SensorError(f"driver 'mujoco' has no kind '{device.kind}'; it has: {', '.join(KINDS)}")
    faults = device.options.get(FAULTS)
    if faults is None:
        return KINDS[device.kind](device, surroundings.world)
    if not isinstance(faults, str):
        raise SensorError(f"option '{FAULTS}' of '{device.name}' is {faults!r}; it must be the path of a file")
    options = {name: value for name, value in device.options.items() if name != FAULTS}
    healthy = KINDS[device.kind](msgspec.structs.replace(device, options=options), surroundings.world)
    return with_faults(healthy, device, folder / faults)

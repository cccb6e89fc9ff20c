"""Sensors of a single quantity of the simulated room, and a door contact."""

import math
import time
from collections.abc import Mapping
from typing import Any

from device_agent.ports.sensor import SensorError, Values
from device_agent.ports.simulation import SimulatedWorld
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.mujoco.base import SimulatedSensor
from device_agent.sensors.mujoco.noise import NOISE, SensorNoise, generator

_SHUT_RAD = math.radians(2)


class Meter(SimulatedSensor):
    """Reads one quantity of the room, with realistic errors. Each of its streams carries it.

    Args:
        device: Its entry in the room's manifest.
        world: Its world.
        quantity: With its unit, as ``temperature_c``.
    """

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld, quantity: str) -> None:
        super().__init__(device, world)
        self._quantity = quantity
        self._noise = SensorNoise(NOISE[quantity], generator(device.name, self.option("seed", 0)))

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        if stream not in {known.name for known in self._device.streams}:
            return super().read(stream)
        self.require()
        quantities = self._world.quantities
        if self._quantity not in quantities:
            raise SensorError(f"this room has no {self._quantity}; it has: {', '.join(quantities) or 'none'}")
        return {self._quantity: self._noise.read(quantities[self._quantity], time.monotonic())}


class Contact(SimulatedSensor):
    """A reed contact at a door or window. Each of its streams carries ``open``.

    Options: ``joint``, the door's name in the room's model (default: the device's name); ``shut_rad``: a smaller angle
    counts as shut.
    """

    OPTIONS: Mapping[str, type | tuple[type, ...]] = {"joint": str, "shut_rad": (int, float)}

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld) -> None:
        super().__init__(device, world)
        self._name: str = self.option("joint", device.name)
        self._shut_rad = float(self.option("shut_rad", _SHUT_RAD))
        self._qpos = 0

    def on_connect(self, model: Any) -> None:
        """See ``SimulatedSensor``."""
        self._qpos = int(model.jnt_qposadr[self.find(model, "joint", self._name)])

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        if stream not in {known.name for known in self._device.streams}:
            return super().read(stream)
        self.require()
        with self.view.current() as (data, _):
            return {"open": abs(float(data.qpos[self._qpos])) > self._shut_rad}

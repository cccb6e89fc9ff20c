"""The laboratory's simulation with time advanced by the test, and drivers of its devices."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from device_agent import sensors
from device_agent.ports.sensor import RoomDriver, Surroundings
from device_agent.ports.simulation import Process
from device_agent.protocol.manifests import robot_type, room
from device_agent.protocol.manifests.room import Room, RoomDeviceManifest
from device_agent.simulation import world_registry
from tests.harness.paths import ROOT

if TYPE_CHECKING:
    from device_agent.drivers.mujoco import World

ROBOTS = Path(ROOT) / "robots"
LAB = ROBOTS / "rooms" / "lab"
STEP_S = 0.002


class ManualWorld:
    """``ports.world.SimulatedWorld`` whose time advances only in ``advance``."""

    def __init__(self, folder: Path = LAB, manifest: Room | None = None) -> None:
        self.manifest = manifest or room.load(folder)
        types = {robot.type: robot_type.load(ROBOTS / robot.type) for robot in self.manifest.robots}
        self.world: World = world_registry.make(self.manifest, folder, types)
        self.world.build()
        self._folder = folder

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    @property
    def model(self) -> Any:
        return self.world.model

    @property
    def quantities(self) -> Mapping[str, float]:
        return self.world.quantities

    @property
    def settings(self) -> Mapping[str, float]:
        return self.world.settings

    def add(self, process: Process) -> None:
        self.world.add(process)

    def copy(self, into: Any) -> None:
        self.world.copy(into)

    def set(self, name: str, value: float) -> float:
        return self.world.set(name, value)

    def sound(self, name: str, level_db: float, *, for_s: float) -> None:
        self.world.sound(name, level_db, for_s=for_s)

    def advance(self, for_s: float) -> None:
        self.world.step(round(for_s / STEP_S))

    def place(self, name: str) -> tuple[float, float, float]:
        """Current position of a body of the model [m]."""
        x, y, z = self.world.snapshot().body_position_m[self.model.body(name).id].tolist()
        return (x, y, z)

    # ------------------------------------------------------------ devices

    def entry(self, name: str) -> RoomDeviceManifest:
        entry = self.manifest.device(name)
        assert entry is not None
        return entry

    def driver(
        self, device: RoomDeviceManifest | str, neighbours: Mapping[str, RoomDriver] | None = None
    ) -> RoomDriver:
        """A disconnected driver of a device."""
        entry = self.entry(device) if isinstance(device, str) else device
        surroundings = Surroundings(neighbours=neighbours or {}, world=self)
        return sensors.load(entry.driver)(entry, self._folder, surroundings)

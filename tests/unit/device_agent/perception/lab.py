"""The laboratory with its own sensors and perception, and robots moved as the agent moves them."""

import contextlib
import dataclasses
import math
import threading
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from device_agent.drivers.mujoco import driver
from device_agent.ports.driver import Twist
from device_agent.ports.sensor import Image, RoomDriver, Scan
from device_agent.protocol.manifests.room import Room
from device_agent.sensors.mujoco import cameras, shared_view
from device_agent.sensors.perception import PerceptionDriver
from device_agent.simulation import renderer
from tests.harness.agent.rooms import LAB, ROBOTS, ManualWorld
from tests.unit.robots.simulated_robot import SimulatedRobot

SENSORS = ("lidar", "depth", "depth_ceiling")
SAMPLE_EVERY = {"depth_ceiling": 2}
"""Number of periods per sample, as in the room's manifest."""
PERIOD_S = 0.2
WALK = (Twist(0.1, 0.0, 0.0), Twist(0.08, 0.0, 0.3), Twist(-0.05, 0.0, 0.3), Twist(0.0, 0.05, 0.0))
"""Twists of NAO, one after the other; it stays near its start."""


@contextlib.contextmanager
def manual_time() -> Iterator[None]:
    """Manual time: no cached views and no timeouts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared_view, "OLDEST_S", -1.0)
        patch.setattr(cameras, "FRESH_S", -1.0)
        patch.setattr(renderer, "TIMEOUT_S", 60.0)
        patch.setattr(driver, "STALE_S", math.inf)
        yield


class LabFixture:
    """The laboratory, with perception in simulated time at a period of ``PERIOD_S``.

    Args:
        manifest: Manifest of the room; by default that of the laboratory.
        walks: Whether NAO has a controller.

    Attributes:
        walked_m: Length of NAO's path.
    """

    def __init__(self, manifest: Room | None = None, *, walks: bool = False) -> None:
        self.world = ManualWorld(LAB, manifest)
        self.nao = SimulatedRobot(ROBOTS / "nao", room=self.world.world) if walks else None
        self._walk_ended = threading.Event()
        self._walk_ended.set()
        self.sensors: dict[str, RoomDriver] = {name: self.world.driver(name) for name in SENSORS}
        for sensor in self.sensors.values():
            sensor.connect()
        self._start_rad: dict[str, float] = {}
        self.walked_m = 0.0
        self._periods = 0
        self.restart()

    def restart(self) -> None:
        """Restart perception."""
        entry = self.world.entry("perception")
        options = {**entry.options, "cameras": list(SENSORS[1:]), "light": ""}
        self.fusion = PerceptionDriver(msgspec.structs.replace(entry, options=options), LAB, self.sensors).make()

    def close(self) -> None:
        for sensor in self.sensors.values():
            sensor.close()

    @property
    def now_s(self) -> float:
        return self.world.world.snapshot().time_s

    def raw(self, name: str) -> Scan | Image:
        raw = self.sensors[name].raw()
        assert raw is not None
        return dataclasses.replace(raw, taken_s=self.now_s)

    def run(self, duration_s: float) -> dict[str, list[float]]:
        """Position error of each object in each period [m]; infinite for unknown objects."""
        errors_m: dict[str, list[float]] = {name: [] for name in self.truth()}
        assert self.nao is not None
        for _ in range(round(duration_s / PERIOD_S)):
            before = self.truth()["nao"]
            self.nao.wait(PERIOD_S)
            self.walked_m += math.dist(before, self.truth()["nao"])
            self.sample()
            positions = self.fusion.positions(self.now_s)
            for name, at in self.truth().items():
                error_m = math.dist(at, (positions[name].x_m, positions[name].y_m)) if name in positions else math.inf
                errors_m[name].append(error_m)
        return errors_m

    def sample(self) -> None:
        """Process one sample of each sensor."""
        for name in SENSORS:
            if self._periods % SAMPLE_EVERY.get(name, 1) == 0:
                self.fusion.update(name, self.raw(name))
        self._periods += 1
        self.fusion.advance(self.now_s)

    def truth(self) -> dict[str, tuple[float, float]]:
        """True positions of all objects."""
        model = self.world.model
        names: list[str] = [model.body(index).name for index in range(model.nbody)]
        bodies = {person.name: person.name for person in self.world.manifest.people}
        for robot in self.world.manifest.robots:  # its base is its first body
            bodies[robot.name] = next(name for name in names if name.startswith(f"{robot.name}/"))
        return {name: self.world.place(body)[:2] for name, body in bodies.items()}

    def start_motions(self, turn: int) -> None:
        """Start the next motions: Qbo drives, NAO walks when idle, the arm and the head turn."""
        forward_rad_s, turn_rad_s = 2.0 if turn % 4 < 2 else -2.0, 1.0 if turn % 3 else -1.0
        self.command("qbo/left_wheel", forward_rad_s - turn_rad_s)
        self.command("qbo/right_wheel", forward_rad_s + turn_rad_s)
        if self.nao is not None and self._walk_ended.is_set():
            walk = self.nao.controller.start_drive(self.nao.reservation, WALK[turn % len(WALK)], duration_s=6.0)
            self._walk_ended = walk.finished
        for actuator, reach_rad in (("ur5/shoulder_pan", 1.0), ("ur5/elbow", 0.4), ("hanson/Neck-Rotation", 0.5)):
            offset_rad = reach_rad if turn % 2 else -reach_rad
            at_rad = float(self.world.world.snapshot().ctrl[self.world.model.actuator(actuator).id])
            self.command(actuator, self._start_rad.setdefault(actuator, at_rad) + offset_rad, ramp_s=3.0)

    def command(self, actuator: str, target: float, *, ramp_s: float = 0.0) -> None:
        """Move one motor."""
        index = np.array([self.world.model.actuator(actuator).id])
        self.world.world.command(actuator, index, [target], ramp_s=ramp_s)

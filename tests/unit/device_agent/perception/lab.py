"""The laboratory with its own sensors and perception, its robots moved as the agent moves them, against the truth."""

import contextlib
import dataclasses
import math
import threading
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec
import numpy as np
import pytest

from device_agent.drivers.mujoco import BipedDriver, driver
from device_agent.ports.driver import Twist
from device_agent.ports.sensor import Image, RoomDriver, Scan
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.room import Room
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.sensors.mujoco import cameras, shared_view
from device_agent.sensors.perception import PerceptionDriver
from device_agent.simulation import renderer
from tests.harness.agent.rooms import LAB, ROBOTS, StillWorld

EYES = ("lidar", "depth", "depth_ceiling")
EVERY = {"depth_ceiling": 2}
"""Which is looked with at every second look only: the room's manifest has it so, too."""
PERIOD_S = 0.2
WALK = (Twist(0.1, 0.0, 0.0), Twist(0.08, 0.0, 0.3), Twist(-0.05, 0.0, 0.3), Twist(0.0, 0.05, 0.0))
"""What NAO does, one after the other: it stays about where it began."""


@contextlib.contextmanager
def by_hand() -> Iterator[None]:
    """Manual time: no cached views and no timeouts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared_view, "OLDEST_S", -1.0)
        patch.setattr(cameras, "FRESH_S", -1.0)
        patch.setattr(renderer, "TIMEOUT_S", 60.0)
        patch.setattr(driver, "STALE_S", math.inf)
        yield


class Watched:
    """The laboratory, looked at ``1 / PERIOD_S`` times a second of its own time.

    Args:
        manifest: Of the room; the laboratory's own without one.
        walks: Whether NAO is operated, as an agent does: that takes its time.

    Attributes:
        walked_m: The length of NAO's way.
    """

    def __init__(self, manifest: Room | None = None, *, walks: bool = False) -> None:
        self.world = StillWorld(LAB, manifest)
        self.nao = Nao(self.world) if walks else None
        self.eyes: dict[str, RoomDriver] = {name: self.world.driver(name) for name in EYES}
        for eye in self.eyes.values():
            eye.connect()
        self._begun_rad: dict[str, float] = {}
        self.walked_m = 0.0
        self._looks = 0
        self.begin()

    def begin(self) -> None:
        """Forget all that was seen."""
        entry = self.world.entry("perception")
        options = {**entry.options, "cameras": list(EYES[1:]), "light": ""}
        self.sight = PerceptionDriver(msgspec.structs.replace(entry, options=options), LAB, self.eyes).make()

    def close(self) -> None:
        for eye in self.eyes.values():
            eye.close()

    @property
    def now_s(self) -> float:
        return self.world.world.snapshot().time_s

    def raw(self, name: str) -> Scan | Image:
        raw = self.eyes[name].raw()
        assert raw is not None
        return dataclasses.replace(raw, taken_s=self.now_s)

    def look(self, for_s: float) -> dict[str, list[float]]:
        """How far from the truth each is, look by look [m]; infinite for who is not known."""
        found: dict[str, list[float]] = {name: [] for name in self.truth()}
        for _ in range(round(for_s / PERIOD_S)):
            before = self.truth()["nao"] if self.nao is not None else (0.0, 0.0)
            if self.nao is None:
                self.world.go_on(PERIOD_S)
            else:
                self.nao.go_on(PERIOD_S)
                self.walked_m += math.dist(before, self.truth()["nao"])
            self.see()
            places = self.sight.positions(self.now_s)
            for name, at in self.truth().items():
                off = math.dist(at, (places[name].x_m, places[name].y_m)) if name in places else math.inf
                found[name].append(off)
        return found

    def see(self) -> None:
        """One look."""
        for name in EYES:
            if self._looks % EVERY.get(name, 1) == 0:
                self.sight.update(name, self.raw(name))
        self._looks += 1
        self.sight.advance(self.now_s)

    def truth(self) -> dict[str, tuple[float, float]]:
        """True positions of all objects."""
        found = {person.name: self.world.place(person.name)[:2] for person in self.world.manifest.people}
        for robot in self.world.manifest.robots:
            found[robot.name] = self.world.place(robot_base(self.world.model, robot.name))[:2]
        return found

    # ------------------------------------------------------------ who moves

    def go_about(self, turn: int) -> None:
        """Have all robots do something else: Qbo drives, NAO walks when it may, the arm and the head turn."""
        self.drive(forward_rad_s=2.0 if turn % 4 < 2 else -2.0, turn_rad_s=1.0 if turn % 3 else -1.0)
        if self.nao is not None and not self.nao.busy:
            self.nao.walk(WALK[turn % len(WALK)], duration_s=6.0)
        for actuator, reach_rad in (("ur5/shoulder_pan", 1.0), ("ur5/elbow", 0.4), ("hanson/Neck-Rotation", 0.5)):
            way_rad = reach_rad if turn % 2 else -reach_rad
            self.command(actuator, self._begun_rad.setdefault(actuator, self._at_rad(actuator)) + way_rad, ramp_s=3.0)

    def drive(self, *, forward_rad_s: float, turn_rad_s: float) -> None:
        """Turn the wheels of Qbo."""
        self.command("qbo/left_wheel", forward_rad_s - turn_rad_s)
        self.command("qbo/right_wheel", forward_rad_s + turn_rad_s)

    def _at_rad(self, actuator: str) -> float:
        return float(self.world.world.snapshot().ctrl[self.world.model.actuator(actuator).id])

    def command(self, actuator: str, target: float, *, ramp_s: float = 0.0) -> None:
        """Move one motor."""
        index = np.array([self.world.model.actuator(actuator).id])
        self.world.world.command(actuator, index, [target], ramp_s=ramp_s)


class Nao:
    """NAO, moved by the agent's controller through its own driver."""

    def __init__(self, world: StillWorld, name: str = "nao") -> None:
        self._world = world
        self.type = robot_type.load(ROBOTS / "nao")
        self._driver = BipedDriver(robot_type=self.type, world=_Held(world), device=name, prefix=f"{name}/")  # type: ignore[arg-type]
        self._driver.connect()
        self._controller = Controller(self.type, LeaseGate())
        self._controller.start_at([self.type.home_rad[joint.name] for joint in self.type.joints])
        self._tenure = self._controller.reserve(epoch=1, on_revoked=lambda _: None)
        self._now_s = 0.0
        self._ended = threading.Event()
        self._ended.set()

    @property
    def busy(self) -> bool:
        return not self._ended.is_set()

    def posture(self, name: str, speed: float = 0.5) -> None:
        self.move(self.type.home_rad if name == "home" else self.type.postures[name], speed)

    def move(self, position_rad: Mapping[str, float], speed: float) -> None:
        self._ended = self._controller.start_joint_goal(self._tenure, position_rad, speed=speed).finished

    def walk(self, twist: Twist, *, duration_s: float) -> None:
        self._ended = self._controller.start_drive(self._tenure, twist, duration_s=duration_s).finished

    def go_on(self, for_s: float) -> None:
        """What its control loop does, and the physics."""
        period_s = self.type.period_ms / 1000
        for _ in range(round(for_s / period_s)):
            self._now_s += period_s
            self._driver.observe()
            tick = self._controller.update(self._now_s)
            self._controller.record_applied(self._driver.send(tick.position_rad))
            self._driver.drive(tick.twist)
            self._world.go_on(period_s)


class _Held:
    """The world for a robot's driver, which then neither starts nor ends its time."""

    def __init__(self, world: StillWorld) -> None:
        self._world = world.world

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass


def robot_base(model: Any, robot: str) -> str:
    """The top body of a robot in a room."""
    names: list[str] = [model.body(index).name for index in range(model.nbody)]
    return next(name for name in names if name.startswith(f"{robot}/"))

"""What the laboratory's own perception finds with the laboratory's own sensors, against the truth of the simulation."""

import dataclasses
import math
import statistics
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from device_agent.ports.sensor import Image, RoomDriver, Scan
from device_agent.sensors.mujoco import cameras, view
from device_agent.sensors.perception import PerceptionDriver
from tests.support.rooms import LAB, StillWorld

MEDIAN_M = 0.15
"""What issue 5 promises."""
EYES = ("lidar", "depth")
PERIOD_S = 0.2
SAME = 0.01
"""Share of beams and pixels that may see something else than the survey."""


@pytest.fixture(scope="module", autouse=True)
def _present() -> Iterator[None]:
    """Everything that looks sees the present: time is driven by hand."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(view, "OLDEST_S", -1.0)
        patch.setattr(cameras, "FRESH_S", -1.0)
        yield


class Watched:
    """The laboratory, looked at ``1 / PERIOD_S`` times a second of its own time."""

    def __init__(self, world: StillWorld) -> None:
        self.world = world
        self.eyes: dict[str, RoomDriver] = {name: world.driver(name) for name in EYES}
        for eye in self.eyes.values():
            eye.connect()
        entry = world.entry("perception")
        options = {**entry.options, "cameras": ["depth"], "light": ""}
        driver = PerceptionDriver(msgspec.structs.replace(entry, options=options), LAB, self.eyes)
        self.sight = driver.make()

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
            self.world.go_on(PERIOD_S)
            for name in EYES:
                self.sight.see(name, self.raw(name))
            self.sight.settle(self.now_s)
            places = self.sight.places(self.now_s)
            for name, at in self.truth().items():
                off = math.dist(at, (places[name].x_m, places[name].y_m)) if name in places else math.inf
                found[name].append(off)
        return found

    def truth(self) -> dict[str, tuple[float, float]]:
        """Who is in the depth camera's view, and where."""
        found = {person.name: self.world.place(person.name)[:2] for person in self.world.manifest.people}
        for robot in self.world.manifest.robots:
            if robot.position_m[2] == 0:  # those on tables are not in the picture
                base = robot_base(self.world.model, robot.name)
                found[robot.name] = self.world.place(base)[:2]
        return found


def robot_base(model: Any, robot: str) -> str:
    """The top body of a robot in a room."""
    names: list[str] = [model.body(index).name for index in range(model.nbody)]
    return next(name for name in names if name.startswith(f"{robot}/"))


def show(found: dict[str, list[float]]) -> None:
    for name, off in found.items():
        known = [each for each in off if math.isfinite(each)]
        print(f"{name}: median {statistics.median(off):.3f} m, 95 % {np.percentile(known, 95):.3f} m, "
              f"most {max(known):.3f} m, unknown {len(off) - len(known)} of {len(off)}")  # fmt: skip


def test_the_survey_is_of_this_room() -> None:
    """When this fails the furniture has moved: `python robots/rooms/survey.py lab`."""
    manifest = StillWorld().manifest
    watched = Watched(StillWorld(LAB, msgspec.structs.replace(manifest, robots=(), people=())))
    watched.world.add(Nobody())
    watched.world.go_on(4.0)
    try:
        for name in EYES:
            assert watched.sight.survey.differs(name, watched.raw(name)) < SAME, name
    finally:
        watched.close()


class Nobody:
    def step(self, model: Any, data: Any, time_s: float) -> None:  # noqa: ARG002 - as `Process` has it
        data.mocap_pos[:, 2] = -50.0


@pytest.fixture(scope="module")
def seen() -> tuple[Watched, dict[str, list[float]]]:
    """The laboratory after a while of watching, and how far off everybody was meanwhile."""
    watched = Watched(StillWorld())
    try:
        watched.look(3.0)
        return watched, watched.look(16.0)
    finally:
        watched.close()


def test_a_person_and_robots_are_found_within_the_promise(seen: tuple[Watched, dict[str, list[float]]]) -> None:
    _, found = seen
    show(found)
    assert "person" in found
    assert all(statistics.median(off) <= MEDIAN_M for off in found.values())


def test_walls_and_tables_of_the_laboratory_are_blocked_and_its_floor_is_free(
    seen: tuple[Watched, dict[str, list[float]]],
) -> None:
    watched, _ = seen
    floor = watched.sight.grid.blocked(0.2, apart=[(*at, 0.4) for at in watched.truth().values()])
    plan = watched.world.manifest.plan
    for x_m, y_m in ((-1.5, -0.3), (-0.4, -0.5), (1.0, -0.8), (0.9, 0.0)):
        assert not floor.at(x_m, y_m), (x_m, y_m)
    table = watched.world.place("ur5/base")
    assert floor.at(table[0] - 0.4, table[1])
    for x_m in np.arange(plan.lower_m[0] + 0.5, plan.upper_m[0] - 0.5, 0.25):
        assert floor.at(float(x_m), plan.upper_m[1] - 0.1)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_a_person_and_robots_are_found_for_minutes_while_a_robot_drives() -> None:
    watched = Watched(StillWorld())
    try:
        watched.look(3.0)
        found: dict[str, list[float]] = {}
        for turn in range(60):
            drive(watched.world, forward_rad_s=2.0 if turn % 4 < 2 else -2.0, turn_rad_s=1.0 if turn % 3 else -1.0)
            for name, off in watched.look(4.0).items():
                found.setdefault(name, []).extend(off)
    finally:
        watched.close()
    show(found)
    assert all(statistics.median(off) <= MEDIAN_M for off in found.values())


def drive(world: StillWorld, *, forward_rad_s: float, turn_rad_s: float) -> None:
    """Turn the wheels of Qbo."""
    model = world.model
    wheels = [model.actuator(f"qbo/{side}").id for side in ("left_wheel", "right_wheel")]
    world.world.command("test", np.array(wheels), [forward_rad_s - turn_rad_s, forward_rad_s + turn_rad_s])

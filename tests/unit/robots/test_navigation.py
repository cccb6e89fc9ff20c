"""Qbo drives to places in the laboratory: physics, the room's own sensors, and manual time."""

import json
import math
import random
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.ports import script_calls
from device_agent.protocol import GoTo, Measurements
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import Reading, ReadingCache
from device_agent.sandbox import api
from device_agent.sensors.perception.driver import _flat
from tests.harness.paths import ROBOTS
from tests.unit.device_agent.perception.lab import PERIOD_S as SAMPLE_S
from tests.unit.device_agent.perception.lab import LabFixture, manual_time
from tests.unit.robots.simulated_robot import SimulatedRobot

NEAR_M, NEAR_RAD = 0.1, math.radians(10)


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def _manual_time() -> Iterator[None]:
    with manual_time():
        yield


class SteppingEvent(threading.Event):
    """Waiting steps the laboratory, so that everything runs in one thread."""

    def __init__(self, lab: "Laboratory") -> None:
        super().__init__()
        self._lab = lab

    def wait(self, timeout: float | None = None) -> bool:
        until_s = self._lab.now_s + (60.0 if timeout is None else timeout)
        while not self.is_set() and self._lab.now_s < until_s - self._lab.period_s / 2:
            self._lab.run_period()
        return self.is_set()


class SteppingController(Controller):
    """The agent's controller; waiting for its goals steps the laboratory."""

    def __init__(self, lab: "Laboratory") -> None:
        super().__init__(lab.type, LeaseGate())
        self._lab = lab

    def start_drive(self, *args: Any, **kwargs: Any) -> Any:
        goal = super().start_drive(*args, **kwargs)
        goal.finished = SteppingEvent(self._lab)
        return goal

    def start_joint_goal(self, *args: Any, **kwargs: Any) -> Any:
        goal = super().start_joint_goal(*args, **kwargs)
        goal.finished = SteppingEvent(self._lab)
        return goal


class Laboratory(SimulatedRobot):
    """A robot in its room, with driver, controller and obstacle map; the person walks, perception runs at 5 Hz."""

    def __init__(self, *, settle_s: float = 3.0, robot: str = "qbo") -> None:
        self.room = LabFixture()
        super().__init__(ROBOTS / robot, room=self.room.world.world)
        self.controller = SteppingController(self)
        self.controller.start_at(self.driver.observe().position_rad)
        self.readings = ReadingCache(
            space="s",
            agent="a",
            own=["perception"],
            named=[("perception", "positions")],
            clock_s=lambda: self.room.now_s,
        )
        self.sampled_s = -math.inf
        self.touched: set[str] = set()
        context = DeviceContext(
            robot_type=self.type,
            controller=self.controller,
            observe=self.driver.observe,
            geometry=None,
            skills=None,
            readings=self.readings,
            own_readings=lambda: {
                stream.name: Reading(self.driver.report(stream.name), 0.02)
                for stream in self.type.streams
                if stream.name in {"odometry", "sonar"}
            },
            name=robot,
            obstacle_map=lambda: self.room.fusion.grid,
        )
        self.robot = RobotApi(context)
        self.wait(settle_s)
        self.robot.reserve(1, lambda _: None)

    def run_period(self) -> None:
        super().run_period()
        if self.room.now_s - self.sampled_s >= SAMPLE_S - self.period_s / 2:
            self.sample()

    def touching(self) -> set[str]:
        """Names of the geoms that it touches, except the floor."""
        data, model = self.world._data, self.model
        touched = set()
        for pair in data.contact.geom[: data.ncon]:
            own = [model.body_rootid[model.geom_bodyid[geom]] == self.body for geom in pair]
            if own[0] != own[1]:
                touched.add(model.geom(pair[own.index(False)]).name)
        return touched - {"floor"}

    def free(self, x_m: float, y_m: float) -> bool:
        """Whether the robot fits there with a margin of one cell for moving legs."""
        grid = self.room.fusion.grid
        return not grid.blocked(self.type.base.radius_m + 0.15).at(x_m, y_m)  # type: ignore[union-attr]

    def sample(self) -> None:
        now_s = self.sampled_s = self.room.now_s
        self.room.sample()
        tick_ms, values = round(now_s * 1000), _flat(self.room.fusion.positions(now_s))
        measured = Measurements(tick_ms=tick_ms, at_ms=0, sequence=tick_ms, values=values)
        self.readings.record("perception", "positions", measured)
        self.touched |= self.touching()

    def close(self) -> None:
        self.robot.release()
        self.room.close()


@pytest.fixture
def lab() -> Iterator[Laboratory]:
    lab = Laboratory()
    yield lab
    lab.close()


def play(lab: Laboratory, movement: str, parameters: dict[str, Any]) -> list[str]:
    """Runs a movement of Qbo as the sandbox would; returns the printed and spoken lines."""
    lines: list[str] = []

    def request(kind: str, **arguments: Any) -> Any:
        if kind == "say":
            return lines.append(arguments["text"])
        if kind == "look_at":
            return None  # checked by its own tests
        try:
            return lab.robot.execute(script_calls.parse(json.dumps({"kind": kind, **arguments}).encode()))  # type: ignore[arg-type]
        except Refused as refused:
            raise api.RobotError(refused.message) from refused

    path = ROBOTS / "qbo" / "movements" / f"{movement}.py"
    namespace = {
        "robot": api.Robot(request, joints=lab.robot.joints, frames=(), can=lab.robot.calls),
        "room": api.Room(request),
        "parameters": parameters,
        "wait": lab.wait,
        "progress": lambda _: None,
        "print": lambda *words: lines.append(" ".join(map(str, words))),
        "RobotError": api.RobotError,
    }
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), namespace)  # noqa: S102 - our own script
    return lines


def check(lab: Laboratory, x_m: float, y_m: float, yaw_rad: float) -> None:
    lab.robot.execute(GoTo(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad))
    x, y, yaw = lab.pose
    assert math.dist((x, y), (x_m, y_m)) <= NEAR_M
    assert abs(math.remainder(yaw - yaw_rad, 2 * math.pi)) <= NEAR_RAD
    assert not lab.touched


def test_qbo_drives_around_another_robot(lab: Laboratory) -> None:
    with pytest.raises(Refused, match="nearest reachable place is x_m") as refused:
        lab.robot.execute(GoTo(x_m=1.5, y_m=2.0))  # occupied by the arm's table
    assert refused.value.code == "taken"
    check(lab, 0.6, -0.35, 1.0)  # the NAO blocks the straight path


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", range(5))
def test_qbo_visits_several_places_while_a_person_walks(lab: Laboratory, seed: int) -> None:
    rng = random.Random(seed)  # noqa: S311
    visited = 0
    nao_m = lab.room.truth()["nao"]
    while visited < 12:
        x_m, y_m, yaw_rad = rng.uniform(-2.2, 2.2), rng.uniform(-1.8, 1.8), rng.uniform(-math.pi, math.pi)
        if not lab.free(x_m, y_m):
            continue
        try:
            check(lab, x_m, y_m, yaw_rad)
        except Refused as refused:
            if refused.code == "position_conflict":
                lab.wait(2.0)
                assert "stool_seat" in lab.touched, "only what is too low for the depth cameras blocks the robot"
                assert math.dist(lab.room.truth()["nao"], nao_m) < 0.02, "it does not push the other robot"
                return
        else:
            visited += 1
            continue
        # The person stands at the goal and waits for the robot to leave.
        person_m = lab.room.world.place("person")[:2]
        assert math.dist(person_m, (x_m, y_m)) < lab.type.base.radius_m + 0.35  # type: ignore[union-attr]


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("settle_s", [3.0, 9.0, 15.0, 21.0, 27.0])
def test_qbo_visits_a_walking_person(settle_s: float) -> None:
    lab = Laboratory(settle_s=settle_s)
    lines = play(lab, "visit", {})
    lab.close()
    assert lines[0].startswith("stopped"), lines
    assert lines[1] == "Hello!"


@pytest.mark.long
@pytest.mark.parametrize(("dx_m", "dy_m"), [(0.0, 0.5), (-0.4, -0.4)])
def test_nao_walks_to_a_place(dx_m: float, dy_m: float) -> None:
    lab = Laboratory(robot="nao")
    x, y, _ = lab.pose
    lab.robot.execute(GoTo(x_m=x + dx_m, y_m=y + dy_m))
    assert math.dist(lab.pose[:2], (x + dx_m, y + dy_m)) <= NEAR_M
    lab.close()

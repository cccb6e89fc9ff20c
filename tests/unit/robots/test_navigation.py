"""Qbo goes to places in the laboratory: real physics, the room's own sensors, and time that passes by hand."""

import json
import math
import random
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest

from device_agent.drivers.mujoco import WheeledDriver
from device_agent.ports import script_calls
from device_agent.protocol import GoTo, Measurements
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import MotionGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import Reading, ReadingCache
from device_agent.sandbox import api
from device_agent.sensors.perception.driver import _flat
from device_agent.simulation import world_registry
from tests.harness.agent.rooms import STEP_S
from tests.harness.paths import ROBOTS
from tests.unit.device_agent.perception.lab import PERIOD_S as LOOK_S
from tests.unit.device_agent.perception.lab import Watched, by_hand

QBO = robot_type.load(ROBOTS / "qbo")
PERIOD_S = QBO.period_ms / 1000
NEAR_M, NEAR_RAD = 0.15, math.radians(10)


@pytest.fixture(scope="module", autouse=True)
def _present() -> Iterator[None]:
    with by_hand():
        yield


class Meanwhile(threading.Event):
    """Waiting steps the laboratory, so that everything runs in one thread."""

    def __init__(self, lab: "Laboratory") -> None:
        super().__init__()
        self._lab = lab

    def wait(self, timeout: float | None = None) -> bool:
        until_s = self._lab.now_s + (60.0 if timeout is None else timeout)
        while not self.is_set() and self._lab.now_s < until_s - PERIOD_S / 2:
            self._lab.period()
        return self.is_set()


class Steered(Controller):
    """The agent's own controller, whose courses have the laboratory go on while they are waited for."""

    def __init__(self, lab: "Laboratory") -> None:
        super().__init__(QBO, LeaseGate())
        self._laboratory = lab

    def start_drive(self, *order: Any, **more: Any) -> Any:
        return self._waited(super().start_drive(*order, **more))

    def start_joint_goal(self, *order: Any, **more: Any) -> Any:
        return self._waited(super().start_joint_goal(*order, **more))

    def _waited(self, course: MotionGoal) -> MotionGoal:
        course.finished = Meanwhile(self._laboratory)
        return course


class Laboratory:
    """Qbo in its room, with driver, controller and errands; the person walks, the room looks five times a second."""

    def __init__(self, *, settle_s: float = 3.0) -> None:
        self.watched = Watched()
        world = self.watched.world.world
        self.driver = WheeledDriver(robot_type=QBO, world=world, device="qbo", prefix=world_registry.prefix("qbo"))
        self.driver._resolve(world.model)
        self.driver._connected = True
        self.controller = Steered(self)
        self.controller.start_at(self.driver.observe().position_rad)
        self.room = ReadingCache(
            space="s", agent="a", own=["perception"], named=[("perception", "positions")], clock_s=lambda: self.now_s
        )
        self.looked_s = -math.inf
        self.touched: set[str] = set()
        self.body = DeviceContext(
            robot_type=QBO,
            controller=self.controller,
            observe=self.driver.observe,
            geometry=None,
            skills=None,
            readings=self.room,
            own_readings=lambda: {
                stream: Reading(self.driver.report(stream), 0.02) for stream in ("odometry", "sonar")
            },
            name="qbo",
            obstacle_map=lambda: self.watched.sight.grid,
        )
        self.robot = RobotApi(self.body)
        self.go_on(settle_s)
        self.robot.reserve(1, lambda _: None)

    @property
    def now_s(self) -> float:
        return self.watched.now_s

    @property
    def truth(self) -> tuple[float, float, float]:
        """x, y [m], yaw [rad]."""
        snapshot = self.watched.world.world.snapshot()
        x, y, _ = snapshot.body_position_m[self.driver._base].tolist()
        w, _, _, k = snapshot.body_quaternion[self.driver._base].tolist()
        return x, y, math.remainder(2 * math.atan2(k, w), 2 * math.pi)

    def go_on(self, for_s: float) -> None:
        for _ in range(round(for_s / PERIOD_S)):
            self.period()

    def period(self) -> None:
        seen = self.driver.observe()
        tick = self.controller.update(self.now_s, seen.position_rad)
        self.controller.record_applied(self.driver.send(tick.position_rad))
        self.controller.record_driven(tick.twist, self.driver.drive(tick.twist))
        self.watched.world.world.step(round(PERIOD_S / STEP_S))
        if self.now_s - self.looked_s >= LOOK_S - PERIOD_S / 2:
            self.look()

    def touching(self) -> set[str]:
        """What of the room or its other robots it touches, but for the floor."""
        world = self.watched.world.world
        data, model = world._data, world.model
        pairs = [[model.geom(geom) for geom in pair] for pair in data.contact.geom[: data.ncon]]
        own = [[model.body(int(geom.bodyid[0])).name.startswith("qbo/") for geom in pair] for pair in pairs]
        others = {pair[mine[0]].name for pair, mine in zip(pairs, own, strict=True) if mine[0] != mine[1]}
        return others - {"floor"}

    def free(self, x_m: float, y_m: float) -> bool:
        """Whether the robot fits there with a margin of one cell for moving legs."""
        grid = self.watched.sight.grid
        return not grid.blocked(QBO.base.radius_m + 0.15).at(x_m, y_m)  # type: ignore[union-attr]

    def look(self) -> None:
        now_s = self.looked_s = self.now_s
        self.watched.see()
        told = _flat(self.watched.sight.positions(now_s))
        tick_ms = round(now_s * 1000)
        self.room.record(
            "perception", "positions", Measurements(tick_ms=tick_ms, at_ms=0, sequence=tick_ms, values=told)
        )
        self.touched |= self.touching()

    def close(self) -> None:
        self.robot.release()
        self.watched.close()


@pytest.fixture
def lab() -> Iterator[Laboratory]:
    lab = Laboratory()
    yield lab
    lab.close()


def play(lab: Laboratory, movement: str, parameters: dict[str, Any]) -> list[str]:
    """A movement of Qbo's, as its script's process would run it; gives what it printed and said."""
    heard: list[str] = []

    def ask(kind: str, **arguments: Any) -> Any:
        if kind == "say":
            return heard.append(arguments["text"])
        if kind == "look":
            return None  # checked by its own tests
        try:
            return lab.robot.execute(script_calls.parse(json.dumps({"kind": kind, **arguments}).encode()))  # type: ignore[arg-type]
        except Refused as refused:
            raise api.RobotError(refused.message) from refused

    path = ROBOTS / "qbo" / "movements" / f"{movement}.py"
    given = {
        "robot": api.Robot(ask, joints=lab.robot.joints, frames=(), can=lab.robot.calls),
        "room": api.Room(ask),
        "parameters": parameters,
        "wait": lab.go_on,
        "progress": lambda _: None,
        "print": lambda *words: heard.append(" ".join(map(str, words))),
        "RobotError": api.RobotError,
    }
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), given)  # noqa: S102 - our own script
    return heard


def check(lab: Laboratory, x_m: float, y_m: float, yaw_rad: float) -> None:
    lab.robot.execute(GoTo(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad))
    x, y, yaw = lab.truth
    assert math.dist((x, y), (x_m, y_m)) <= NEAR_M
    assert abs(math.remainder(yaw - yaw_rad, 2 * math.pi)) <= NEAR_RAD
    assert not lab.touched


def test_qbo_drives_around_another_robot(lab: Laboratory) -> None:
    with pytest.raises(Refused, match="nearest reachable place is x_m") as refused:
        lab.robot.execute(GoTo(x_m=1.5, y_m=2.0))  # the arm's table stands there
    assert refused.value.code == "taken"
    check(lab, 0.6, -0.35, 1.0)  # straight there stands the NAO


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_qbo_visits_several_places_while_a_person_walks(lab: Laboratory) -> None:
    chance = random.Random(5)  # noqa: S311
    gone = 0
    while gone < 12:
        x_m, y_m, yaw_rad = chance.uniform(-2.2, 2.2), chance.uniform(-1.8, 1.8), chance.uniform(-math.pi, math.pi)
        if not lab.free(x_m, y_m):
            continue
        with suppress(Refused):
            check(lab, x_m, y_m, yaw_rad)
            gone += 1
            continue
        # The person has come meanwhile, and waits for it to go out of the way.
        person_m = lab.watched.world.place("person")[:2]
        assert math.dist(person_m, (x_m, y_m)) < QBO.base.radius_m + 0.35  # type: ignore[union-attr]


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("settle_s", [3.0, 9.0, 15.0, 21.0, 27.0])
def test_qbo_visits_a_walking_person(settle_s: float) -> None:
    lab = Laboratory(settle_s=settle_s)
    heard = play(lab, "visit", {})
    lab.close()
    assert heard[0].startswith("stands"), heard
    assert heard[1] == "Hello!"

"""A robot in motion is at rest 350 ms after the connection between its driver and the robot fails.

``-m long`` cuts 200 times for each driver. The peer's clock measures, because its steps do not depend on the load of
the machine. Commands come from another thread until the driver notices the cut, as in the agent.
"""

import random
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from statistics import median, quantiles

import pytest

from device_agent.ports.driver import UnreachableError
from tests.faults.drivers.robots import (
    Cut,
    Operator,
    Robot,
    RosbridgeArm,
    RospyArm,
    RtdeArm,
    WalkingNao,
    connect,
    until,
)
from tests.harness.robots.ros.ros_system import ros_system

LIMIT_S = 0.35
QUIET_S = 0.4
"""Time without a motion after the repair [s]."""
STILL_RAD = 5e-3
ROBOTS: dict[str, Callable[[], Robot]] = {"naoqi": WalkingNao, "ur": RtdeArm, "rosbridge": RosbridgeArm}


@pytest.fixture(params=["naoqi", "ur", "rosbridge", "rospy"])
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Robot]:
    if request.param == "rospy":
        with ros_system(tmp_path) as system, closing(RospyArm(system)) as arm:
            yield arm
    else:
        with closing(ROBOTS[request.param]()) as robot:
            yield robot


def start(robot: Robot) -> Operator:
    """Connect and move. If the connection is lost meanwhile, connect again, as the agent does."""
    for _ in range(5):
        connect(robot)
        operator = Operator(robot)
        until(lambda: robot.moves() or operator.error, within_s=60.0)  # noqa: B023 (called in this iteration)
        if operator.error is None:
            return operator
    pytest.fail(f"the connection is lost before the robot moves: {operator.error}")


def cut_in_motion(robot: Robot, kind: Cut, delay_s: float) -> float:
    """Cut once, repair, and connect again. Returns the time from the cut to rest [s]."""
    operator = start(robot)
    time.sleep(delay_s)
    cut_s = robot.cut(kind)
    assert isinstance(operator.wait(), UnreachableError)
    until(lambda: robot.now_s() > max(robot.moved_s(), cut_s) + QUIET_S)
    rest_s = robot.moved_s() - cut_s
    before = robot.place()
    repaired_s = robot.now_s()
    robot.restore(kind)
    connect(robot)
    until(lambda: robot.now_s() > repaired_s + QUIET_S)
    moved_rad = max(abs(value - was) for value, was in zip(robot.place(), before, strict=True))
    assert moved_rad <= (robot.late_rad if kind is Cut.LATE else STILL_RAD), f"it moves after the repair ({kind.value})"
    assert robot.moved_s() <= repaired_s + LIMIT_S
    return rest_s


@pytest.mark.parametrize("count", [3, pytest.param(200, marks=[pytest.mark.long, pytest.mark.timeout(3600)])])
def test_a_cut_link_ends_each_motion_in_time(robot: Robot, count: int, request: pytest.FixtureRequest) -> None:
    choice = random.Random(count)
    times: dict[Cut, list[float]] = {kind: [] for kind in robot.cuts}
    for index in range(count):
        kind = robot.cuts[index % len(robot.cuts)]
        times[kind].append(cut_in_motion(robot, kind, choice.uniform(0.0, 0.15)))
    every = [value for values in times.values() for value in values]
    for name, values in {**{kind.value: values for kind, values in times.items()}, "all": every}.items():
        print(request.node.name, name, report(values))
    assert max(every) <= LIMIT_S


def report(values: list[float]) -> str:
    if len(values) < 2:
        return f"{len(values)} cuts"
    p99 = quantiles(values, n=100, method="inclusive")[98]
    return f"{len(values)} cuts; rest after {1000 * median(values):.0f}, {1000 * p99:.0f}, {1000 * max(values):.0f} ms"

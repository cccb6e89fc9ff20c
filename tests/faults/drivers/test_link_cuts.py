"""A robot in motion is at rest 350 ms after the connection between its driver and the robot fails.

``-m long`` cuts 200 times for each driver. The peer's clock measures, because its steps do not depend on the load of
the machine. Commands come from another thread until the driver notices the cut, as in the agent.
"""

import random
import time
from collections.abc import Callable
from statistics import median, quantiles

import pytest

from device_agent.ports.driver import UnreachableError
from tests.faults.drivers.robots import Cut, Operator, Robot, RosbridgeArm, RtdeArm, WalkingNao, connect, until

LIMIT_S = 0.35
QUIET_S = 0.5
"""Time without a motion after the repair [s]."""
ROBOTS: dict[str, Callable[[], Robot]] = {"naoqi": WalkingNao, "ur": RtdeArm, "rosbridge": RosbridgeArm}


def cut_in_motion(robot: Robot, kind: Cut, delay_s: float) -> float:
    """Cut once, repair, and connect again. Returns the time from the cut to rest [s]."""
    connect(robot)
    operator = Operator(robot)
    until(robot.moves)
    time.sleep(delay_s)
    until(robot.moves)
    cut_s = robot.cut(kind)
    assert isinstance(operator.wait(), UnreachableError)
    until(lambda: robot.now_s() > max(robot.moved_s(), cut_s) + QUIET_S)
    rest_s = robot.moved_s() - cut_s
    before = robot.place()
    robot.restore(kind)
    connect(robot)
    start_s = robot.now_s()
    until(lambda: robot.now_s() > start_s + QUIET_S)
    assert robot.place() == pytest.approx(before, abs=5e-3), f"it moves after the repair ({kind.value})"
    return rest_s


@pytest.mark.parametrize("count", [3, pytest.param(200, marks=[pytest.mark.long, pytest.mark.timeout(3600)])])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_cut_link_ends_each_motion_in_time(name: str, count: int) -> None:
    choice = random.Random(count)
    robot = ROBOTS[name]()
    times: dict[Cut, list[float]] = {kind: [] for kind in robot.cuts}
    try:
        for index in range(count):
            kind = robot.cuts[index % len(robot.cuts)]
            times[kind].append(cut_in_motion(robot, kind, choice.uniform(0.0, 0.15)))
    finally:
        robot.close()
        for kind, values in times.items():
            print(name, kind.value, report(values))
    every = [value for values in times.values() for value in values]
    print(name, "all", report(every))
    assert max(every) <= LIMIT_S


def report(values: list[float]) -> str:
    if len(values) < 2:
        return f"{len(values)} cuts"
    p99 = quantiles(values, n=100, method="inclusive")[98]
    return f"{len(values)} cuts; rest after {1000 * median(values):.0f}, {1000 * p99:.0f}, {1000 * max(values):.0f} ms"

"""Cost of one control period, with and without collision checks.

``python -m benchmarks.agent.control_period [TYPE]`` moves a robot type (``ur5``) for one simulated minute per mode. It
prints percentiles of ``Controller.step`` as processor time of the thread [ms], so other load matters little.

- *setpoints*: a new random target every 2 s, 40 setpoints per second with a loop age of 30 ms;
- *moves*: consecutive moves at full speed to random collision-free targets.
"""

import random
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.reporting.report import percentile
from device_agent import geometry
from device_agent.ports.geometry import RobotGeometry
from device_agent.protocol import JointTarget, Setpoint
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused

ROBOTS = Path(__file__).resolve().parents[2] / "robots"
SIMULATED_S = 60.0
SETPOINT_PERIODS = 3
TARGET_S = 2.0
LOOP_AGE_MS = 30
Source = Callable[[Controller, RobotType], Iterator[None]]


def _random_target(kind: RobotType, chance: random.Random) -> dict[str, float]:
    return {
        joint.name: min(max(kind.home_rad[joint.name] + chance.uniform(-1, 1), joint.lower_rad), joint.upper_rad)
        for joint in kind.joints
    }


def setpoints(controller: Controller, kind: RobotType) -> Iterator[None]:
    """Sends setpoints as an operator does, before each period."""
    chance, sequence, target = random.Random(1), 0, dict(kind.home_rad)
    controller.grant(epoch=1, holder="ann", lease_s=1e6, now_s=0.0)
    for period in range(round(SIMULATED_S * 1000 / kind.period_ms)):
        now_ms = period * kind.period_ms
        if period % round(TARGET_S * 1000 / kind.period_ms) == 0:
            target = _random_target(kind, chance)
        if period % SETPOINT_PERIODS == 0:
            sequence += 1
            setpoint = Setpoint(
                epoch=1, sequence=sequence, echo_tick_ms=now_ms, sent_ms=0.0, target=JointTarget(position_rad=target)
            )
            controller.accept_setpoint(setpoint, now_s=now_ms / 1000, tick_ms=now_ms + LOOP_AGE_MS)
        yield


def moves(controller: Controller, kind: RobotType) -> Iterator[None]:
    """Starts moves as a movement script does, before each period."""
    chance = random.Random(2)
    tenure = controller.reserve(epoch=1, on_revoked=lambda _: None)
    move = None
    for _ in range(round(SIMULATED_S * 1000 / kind.period_ms)):
        while move is None or move.finished.is_set():
            try:
                move = controller.start_joint_goal(tenure, _random_target(kind, chance), speed=1.0)
            except Refused:
                continue  # the target collides: choose another one
        yield


def measure(kind: RobotType, shape: RobotGeometry | None, source: Source) -> list[float]:
    """Returns the processor time of each step with motion [ms]."""
    controller = Controller(kind, LeaseGate(), geometry=shape)
    controller.start_at([kind.home_rad[joint.name] for joint in kind.joints])
    durations_ms = []
    for period, _ in enumerate(source(controller, kind)):
        started_s = time.thread_time()
        controller.update(period * kind.period_ms / 1000)
        if controller.moving:
            durations_ms.append((time.thread_time() - started_s) * 1000)
    return durations_ms


def main() -> None:
    """Runs the command line."""
    name = sys.argv[1] if len(sys.argv) > 1 else "ur5"
    kind = robot_type.load(ROBOTS / name)
    shape = geometry.load(kind, ROBOTS / name)
    print(f"{name}, a period of {kind.period_ms} ms; ms of processor time")
    print(f"{'':34}{'p50':>8}{'p95':>8}{'p99':>8}{'max':>8}")
    for label, source in (("setpoints", setpoints), ("moves", moves)):
        for checked, description in ((None, "ranges only"), (shape, "with collision checks")):
            times = measure(kind, checked, source)
            percentiles = "".join(f"{percentile(times, share):8.3f}" for share in (0.5, 0.95, 0.99, 1))
            print(f"{label + ', ' + description:34}{percentiles}")


if __name__ == "__main__":
    main()

"""A robot with a reset of objects and a monitor whose observations the test defines."""

import threading
from collections.abc import Callable, Sequence

import msgspec

from device_agent.ports.driver import DriverError
from device_agent.ports.skills import BehaviourContext, SkillError, TaskState
from device_agent.protocol import Ack, Control, RunTrial, TrialCause, TrialReport
from device_agent.protocol.manifests import tasks
from device_agent.protocol.manifests.tasks import Tasks
from tests.fakes.drivers import FakeDriver
from tests.harness.agent.device_harness import DeviceHarness

MANIFEST = tasks.parse("""
[[objects]]
name = "cube"
lower_m = [0.0, 0.0]
upper_m = [1.0, 1.0]
mass_kg = [0.1, 0.2]
friction = [0.5, 0.6]

[[regions]]
name = "tray"
lower_m = [0.0, 0.0, 0.0]
upper_m = [0.1, 0.1, 0.1]

[[tasks]]
name = "cube_in_tray"
label = "Cube into the tray"
description = "Place the cube in the tray."
movement = "dance"
time_limit_s = 60.0
success = { object = "cube", region = "tray", rest_s = 1.0, lifted_m = 0.05 }

[[measured_tasks]]
name = "press_button"
label = "Press the button"
description = "Press the button until it is released by the timer."
movement = "dance"
time_limit_s = 60.0
success = { device = "b-button", stream = "state", field = "pressed", equals = true, rest_s = 0.05, stale_s = 60.0 }
""")


class FakeMonitor:
    """Its clock advances by ``step_s`` with each look, so that a test does not depend on real time.

    Attributes:
        is_met: Whether the condition is met at a time since the restart [s].
        broken: Raise errors from the look with this number on.
    """

    def __init__(self) -> None:
        self.step_s = 0.1
        self.is_met: Callable[[float], bool] = lambda _: False
        self.broken = 10**9
        self.time_s = 5.0
        self.started_s: float | None = None
        self.looks = self.restarts = 0
        self.closed = threading.Event()
        self.looked = threading.Event()

    def restart(self) -> None:
        self.started_s = self.time_s
        self.restarts += 1

    def state(self) -> TaskState:
        self.looks += 1
        if self.looks >= self.broken:
            raise DriverError("the simulation has stopped")
        self.time_s += self.step_s
        if self.started_s is not None:
            self.looked.set()
        met = self.started_s is not None and self.is_met(self.time_s - self.started_s)
        return TaskState(time_s=self.time_s, met=met, failure=TrialCause.INCOMPLETE, detail="it fell")

    def close(self) -> None:
        self.closed.set()


class TrialRobot(FakeDriver):
    """A simulated robot that resets objects and observes tasks."""

    controls: Sequence[Control] = (Control(name="reset_objects", label="Reset", lower=0, upper=1_000_000),)

    def __init__(self) -> None:
        super().__init__()
        self.monitor = FakeMonitor()
        self.seeds: list[float] = []
        self.near = False
        self.in_room = False

    def set_control(self, name: str, value: float, context: BehaviourContext) -> float:
        del name, context
        if self.near:
            raise SkillError("the gripper is near the cube")
        self.seeds.append(value)
        return value

    def observe_task(self, manifest: Tasks, task: str) -> FakeMonitor:
        assert manifest.task(task).movement == "dance"
        if self.in_room:
            raise DriverError("the room has other objects")
        return self.monitor


def trial(
    harness: DeviceHarness,
    source: str = "print('moved')",
    *,
    name: str = "cube_in_tray",
    seed: int | None = 7,
    sha256: str = MANIFEST.sha256,
) -> RunTrial:
    """A command to run a trial with this script."""
    return RunTrial(name=name, tasks_sha256=sha256, seed=seed, movement=harness.script(source))


def report_of(ack: Ack) -> TrialReport:
    """The report in the result of an action."""
    return msgspec.convert(ack.result["trial"], TrialReport)

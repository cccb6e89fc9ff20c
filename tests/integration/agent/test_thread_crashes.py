"""Each thread of a real agent crashes or hangs while its robot moves: the robot rests, and the fault is reported.

The running agent itself lists the threads. A thread without supervision fails the test.
"""

import contextlib
import ctypes
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast
from unittest import mock

import numpy as np
import pytest

from device_agent import bootstrap
from device_agent.ports import threads
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol import Ack, AckStatus, Drive, Event, GrantLease, Mode, MoveJoints, State, StopDevice, topics
from device_agent.protocol.events import EventKind
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.control.goals import MotionGoal
from device_agent.runtime.supervision import CHECK_PERIOD_S, Failure
from device_agent.runtime.telemetry import latency_probe
from tests.fixtures.brokers import Brokers
from tests.harness.agent.custom_agent import DEVICE, AgentProcess, FileApi
from tests.harness.agent.thread_crashes import InjectedCrash, crash, hanging
from tests.harness.network.brokers import PATIENCE_S, RunningBroker

MOTION: Mapping[str, MoveJoints | Drive] = {
    "ur5": MoveJoints(position_rad={"shoulder_pan": 6.0}, speed=0.08),
    "qbo": Drive(forward_m_s=0.2, duration_s=60.0),
    "nao": Drive(forward_m_s=0.05, duration_s=60.0),
}
"""Robot type → a motion of an arm, a wheeled and a walking robot that lasts longer than the test."""
CAMERAS = {"qbo"}
MOVING, RESTING = 0.15, 0.05
"""Largest speed of any joint or base [rad/s, m/s]."""
QUIET_S = 0.5
"""A robot rests when it was slower than ``RESTING`` for this simulated time."""
MAX_REST_S = 2.5
"""Maximum simulated time from the crash to rest; a walking robot finishes its step."""
MAX_DETECTION_S = 1.0
LOOP, COMMANDS, WORLD = f"{DEVICE}-loop", f"{DEVICE}-commands", "mujoco-world"
CONFIRMS_NO_STOP = {LOOP, COMMANDS}
HANGING_S = {LOOP: 1.0, COMMANDS: 3.3, "mqtt": 5.3, WORLD: 2.3}
"""Essential thread → maximum time until the supervisor notices that it hangs."""


class MovingAgent(AgentProcess):
    """A real agent with a simulated robot in this process, which moves under lease 1. The test is its supervisor."""

    name = DEVICE

    def __init__(self, folder: Path, broker: RunningBroker, robot: str) -> None:
        super().__init__(folder, broker, f'[[devices]]\nname = "{DEVICE}"\ntype = "{robot}"\n')
        self.robot = robot
        self.others = set(threading.enumerate())
        self.reason = ""
        self.moved_s = 0.0
        self.failures: list[Failure] = []
        self.agent = bootstrap.build(self.store)
        self.agent.supervisor.add(self)
        self.device = self.agent.agent._devices[DEVICE]
        self.driver = cast("Any", self.device._driver)
        self.world = self.driver._world

    def begin(self) -> None:
        """Start the agent and the motion. Every thread that this starts must be supervised."""
        self.agent.start()
        self.ready()
        self.execute(GrantLease(holder="ann", lease_ms=60_000), epoch=1)
        self.action = self.command(MOTION[self.robot], epoch=1)
        self.wait(lambda: self.acked(self.action, AckStatus.STARTED), "the start of the motion")
        self.wait(lambda: self.speed() > MOVING, "motion")
        if self.robot in CAMERAS:
            self.wait(lambda: "renderer" in self.threads(), "a frame of the camera")
        # The second list is taken first: a thread that ends in between is in neither.
        watched = {thread.name for thread in threads.watched()}
        running = {thread.name for thread in set(threading.enumerate()) - self.others}
        assert running <= watched, self.received(topics.ACK, Ack)[-3:]

    def close(self) -> None:
        self.agent.stop()
        self.client.close()

    def threads(self) -> dict[str, SupervisedThread]:
        """The agent's threads by name; that of the running action is ``action``.

        A thread of the previous agent may still wait for an image.
        """
        return {thread.name.partition("-c")[0] if "action" in thread.name else thread.name: thread
                for thread in threads.watched() if thread._thread not in self.others}  # fmt: skip

    def check(self) -> None:
        snapshot = self.world.snapshot()
        if np.abs(snapshot.qvel).max() > RESTING:
            self.moved_s = snapshot.time_s
        self.reason = self.reason or self.agent.supervisor.check()

    def wait(self, condition: Callable[[], object], what: str) -> None:
        """Supervise the agent until the condition holds."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline_s, f"{what}; {self.received(topics.ACK, Ack)[-3:]}"
            self.check()
            time.sleep(CHECK_PERIOD_S / 4)

    @property
    def time_s(self) -> float:
        """Time of the supervisor [s]."""
        now_s: float = self.agent.supervisor._clock._now_s
        return now_s

    def speed(self) -> float:
        return float(np.abs(self.world.snapshot().qvel).max())

    @property
    def noticed(self) -> bool:
        return bool(self.failures) or self.device._controller.fault is not None

    def part_failed(self, failure: Failure) -> None:
        self.failures.append(failure)

    def part_recovered(self, failure: Failure) -> None:
        pass

    def rest_s(self, since_s: float) -> float:
        """Wait for rest; returns the simulated time since ``since_s`` until it began [s]."""
        self.wait(lambda: self.world.snapshot().time_s - self.moved_s > QUIET_S, "rest")
        return max(0.0, self.moved_s - since_s)

    def reports(self) -> list[str]:
        """Codes of the faults in the newest state, and kinds of failure in events."""
        states: list[State] = self.received(topics.STATE, State)
        events: list[Event] = self.received(topics.EVENT, Event)
        failures = {EventKind.PART_FAILED, EventKind.DRIVER_FAILED}
        return [fault.code for state in states[-1:] for fault in state.faults] + [
            event.kind for event in events if event.kind in failures
        ]

    def acked(self, command: str, status: AckStatus) -> bool:
        return any(ack.id == command and ack.status is status for ack in self.received(topics.ACK, Ack))

    def confirmed(self, stop: str) -> bool:
        return self.acked(stop, AckStatus.DONE)


@contextlib.contextmanager
def moving_agent(folder: Path, broker: RunningBroker, robot: str) -> Iterator[MovingAgent]:
    with contextlib.closing(MovingAgent(folder, broker, robot)) as agent:
        agent.begin()
        yield agent


@pytest.fixture(autouse=True)
def local_api(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Credentials come from a file, and idle threads run often."""
    monkeypatch.setattr(bootstrap, "cloud_client", lambda store, _configuration, clock, **_: FileApi(store, clock))
    monkeypatch.setattr(latency_probe, "UPLOAD_PERIOD_S", 0.2)
    wait_for = RobotApi.wait_for

    def wait_in_steps(api: RobotApi, goal: MotionGoal) -> None:
        while not goal.finished.wait(0.05):
            pass
        wait_for(api, goal)

    monkeypatch.setattr(RobotApi, "wait_for", wait_in_steps)
    yield
    threading.excepthook = threading.__excepthook__


def crash_action(thread: SupervisedThread) -> None:
    """End the thread of an action, which has no iterations, at once."""
    assert thread._thread is not None
    identity = ctypes.c_ulong(thread._thread.ident or 0)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(identity, ctypes.py_object(InjectedCrash))


def check_crash(agent: MovingAgent, name: str) -> str:
    """Crash one thread and check the consequences; returns the figures."""
    thread = agent.threads()[name]
    crashed_s = agent.world.snapshot().time_s
    crash_action(thread) if name == "action" else crash(thread)
    began_s = agent.time_s
    agent.wait(lambda: agent.noticed, f"{name} to be noticed")
    detection_s = agent.time_s - began_s
    assert detection_s <= MAX_DETECTION_S, name
    rest_s = agent.rest_s(crashed_s)
    assert rest_s <= MAX_REST_S, name
    agent.wait(agent.reports, f"a report of {name}")
    if name in CONFIRMS_NO_STOP:
        stop = agent.command(StopDevice())
        agent.wait(lambda: agent.reason, f"the end of the process after {name}")
        assert not agent.confirmed(stop), name
    else:
        agent.wait(lambda: name == "action" or thread.is_alive() or name == WORLD, f"the restart of {name}")
        agent.ready()
        stop = agent.command(StopDevice())
        agent.wait(lambda: agent.confirmed(stop), f"a confirmed Stop after {name}")
        assert agent.device._controller.applied_mode is Mode.STOPPED
        assert agent.reason == "", name
    assert agent.final_ack(agent.action).status is AckStatus.FAILED, name
    return f"{name}: noticed {detection_s:.2f} s, rest {rest_s:.2f} s, {agent.reason or 'continues'}"


@pytest.mark.timeout(900)
@pytest.mark.parametrize("robot", MOTION)
def test_each_thread_of_a_moving_robot_may_crash(robot: str, tmp_path: Path, brokers: Brokers) -> None:
    names, figures = [""], list[str]()
    while len(figures) < len(names):
        folder = tmp_path / str(len(figures))
        with moving_agent(folder, brokers("mosquitto"), robot) as agent:
            names = sorted(agent.threads())
            figures.append(check_crash(agent, names[len(figures)]))
    assert len(figures) == len(names) >= 8
    print(*figures, sep="\n")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("robot", MOTION)
def test_a_hanging_driver_of_a_moving_robot_is_reported_within_a_second(
    robot: str, tmp_path: Path, brokers: Brokers
) -> None:
    answers = threading.Event()
    with moving_agent(tmp_path, brokers("mosquitto"), robot) as agent:
        observe = agent.driver.observe

        def hang() -> Any:
            answers.wait()
            return observe()

        hanging_s, began_s = agent.world.snapshot().time_s, agent.time_s
        with mock.patch.object(agent.driver, "observe", hang):
            agent.wait(lambda: agent.noticed, "the hang to be noticed")
            detection_s = agent.time_s - began_s
            assert detection_s <= MAX_DETECTION_S
            rest_s = agent.rest_s(hanging_s)
            assert rest_s <= MAX_REST_S
            agent.wait(agent.reports, "a report")
            stop = agent.command(StopDevice())
            agent.wait(lambda: agent.device._controller.latch is not None, "the latch")
            assert not agent.confirmed(stop)
            answers.set()
        # The loop responds again: it reconnects the driver, and applies the Stop.
        agent.wait(lambda: agent.confirmed(stop), "a confirmed Stop")
        assert agent.speed() <= MOVING
        assert agent.reason == ""
    print(f"{robot}: noticed {detection_s:.2f} s, rest {rest_s:.2f} s")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", HANGING_S)
def test_an_essential_thread_of_a_moving_robot_may_hang(name: str, tmp_path: Path, brokers: Brokers) -> None:
    with moving_agent(tmp_path, brokers("mosquitto"), "ur5") as agent:
        began_s = agent.time_s
        with hanging(agent.threads()[name]):
            agent.wait(lambda: agent.failures, "the hang to be noticed")
            detection_s = agent.time_s - began_s
            assert detection_s <= HANGING_S[name]
            agent.wait(lambda: agent.device._controller.lease(time.monotonic()) is None, "the end of the lease")
            stop = agent.command(StopDevice())
            agent.check()
            assert not agent.confirmed(stop)
        agent.wait(lambda: agent.confirmed(stop), "a confirmed Stop")
        agent.wait(lambda: EventKind.PART_FAILED in agent.reports(), "the report")
        assert agent.final_ack(agent.action).status is AckStatus.FAILED
        assert agent.reason == ""
    print(f"ur5, {name} hangs: noticed {detection_s:.2f} s")

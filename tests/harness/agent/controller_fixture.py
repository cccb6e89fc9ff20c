"""A controller with an operator and a clock; without threads and delays."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from itertools import pairwise

import pytest

from device_agent.ports.geometry import Clearance, RobotGeometry, Sweep, never
from device_agent.protocol import DriveTarget, JogTarget, JointTarget, Mode, Pose, Setpoint, StopLatch
from device_agent.protocol.manifests.robot_type import Base
from device_agent.runtime.authority.authority import Reservation
from device_agent.runtime.authority.event_recorder import RecordEvent, ignore_event
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import JointGoal
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import PERIOD_S, robot_type

WALL_RAD = 1.0
Target = JointTarget | JogTarget | DriveTarget


class ControllerFixture:
    """A controller with its own clock, and an operator whose setpoints refer to the newest telemetry."""

    def __init__(
        self,
        *,
        geometry: RobotGeometry | None = None,
        base: Base | None = None,
        record: RecordEvent = ignore_event,
        **gate: int,
    ) -> None:
        self.controller = Controller(robot_type(base), LeaseGate(**gate), geometry=geometry, record=record)
        self.controller.start_at([0.0, 0.0])
        self.limited: set[str] = set()
        self.now_s = 100.0
        self.sequence = self.input = 0
        self.velocities: list[float] = []
        self.outputs = list[ControlOutput]()
        self.revocations: list[Refused] = []

    def reserve(self, epoch: int = 1) -> Reservation:
        """Reserve the device for an action."""
        return self.controller.reserve(epoch=epoch, on_revoked=self.revocations.append)

    @cached_property
    def reservation(self) -> Reservation:
        """The reservation of the action that ``move`` belongs to."""
        return self.reserve()

    def move(self, speed: float = 1.0, /, **position_rad: float) -> JointGoal:
        """Start a joint goal of an action with lease 1."""
        return self.controller.start_joint_goal(self.reservation, position_rad, speed=speed)

    def stop(self, caller: str = "bob") -> None:
        self.controller.stop(StopLatch(caller=caller, reason="", at_ms=1))

    @property
    def lease_epoch(self) -> int | None:
        lease = self.controller.lease(self.now_s)
        return None if lease is None else lease.epoch

    @property
    def tick_ms(self) -> int:
        return round(self.now_s * 1000)

    def grant(self, epoch: int, lease_s: float = 30.0) -> None:
        self.controller.grant(epoch=epoch, holder="ann", lease_s=lease_s, now_s=self.now_s)
        self.sequence = 0

    def press(self) -> None:
        """Start a new input; without one, setpoints have no input number."""
        self.input += 1

    def offer(self, epoch: int, target: float | Target = 2.0, *, age_ms: int = 20, sequence: int | None = None) -> None:
        """Send a setpoint: a target, or the position of the elbow [rad]."""
        self.sequence += 1
        setpoint = Setpoint(
            epoch=epoch,
            sequence=self.sequence if sequence is None else sequence,
            echo_tick_ms=self.tick_ms - age_ms,
            sent_ms=1.0,
            input=self.input,
            target=JointTarget(position_rad={"elbow": target}) if isinstance(target, float | int) else target,
        )
        self.controller.accept_setpoint(setpoint, now_s=self.now_s, tick_ms=self.tick_ms)

    def run(self, seconds: float) -> Mode:
        before = self.elbow
        for _ in range(round(seconds / PERIOD_S)):
            self.now_s += PERIOD_S
            output = self.controller.update(self.now_s)
            self.outputs.append(output)
            self.limited |= set(output.limited)
            self.elbow = output.position_rad[1]
            self.velocities.append((self.elbow - before) / PERIOD_S)
            before = self.elbow
        return self.controller.mode

    elbow = 0.0

    def stream(self, epoch: int, seconds: float, elbow: float | Target = 2.0, *, age_ms: int = 20) -> Mode:
        mode = self.controller.mode
        for _ in range(round(seconds / 0.024)):
            self.offer(epoch, elbow, age_ms=age_ms)
            mode = self.run(0.024)
        return mode

    def at_rest_after(self, limit_s: float) -> float:
        start = self.now_s
        while self.now_s - start < limit_s:
            self.run(PERIOD_S)
            if not self.controller.moving:
                return self.now_s - start
        pytest.fail(f"still moving after {limit_s} s")


def leased(geometry: RobotGeometry | None = None) -> ControllerFixture:
    """A controller with an operator who has lease 1."""
    fixture = ControllerFixture(geometry=geometry)
    fixture.grant(1)
    return fixture


@contextmanager
def refuses(code: str) -> Iterator[None]:
    """Expect a rejection with this code, and with a text for people."""
    with pytest.raises(Refused) as refused:
        yield
    assert refused.value.code == code
    assert refused.value.message


def ignore_revocation(_: Refused) -> None:
    pass


def interruptions() -> dict[str, Callable[[ControllerFixture], object]]:
    return {
        "stop": lambda fixture: fixture.stop(),
        "link": lambda fixture: fixture.controller.interrupt(Refused("link_lost", "the link is lost")),
        "takeover": lambda fixture: fixture.grant(2),
        "release": lambda fixture: fixture.controller.release(epoch=1),
        "expiry": lambda fixture: fixture.run(6.0),
        "fault": lambda fixture: fixture.controller.set_fault("no response"),
    }


class Wall:
    """An elbow, one metre long, before a wall; beyond the wall it may only return."""

    frames: tuple[str, ...] = ()

    def __init__(self, at_rad: float = WALL_RAD) -> None:
        self.at_rad = at_rad

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        raise NotImplementedError

    def clearance(self, position_rad: Sequence[float]) -> Clearance:
        return Clearance(self.at_rad - position_rad[1], ("hand", "wall"))

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        rooms = [self.clearance(position).excess_m for position in path_rad]
        least = min(0.0, rooms[0]) - 1e-7
        for leg, (begin, end) in enumerate(pairwise(rooms)):
            if end < least:
                share = (leg + (begin - least) / (begin - end)) / (len(rooms) - 1)
                return Sweep(share, Clearance(end, ("hand", "wall")))
        return Sweep(1.0)

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        return self.sweep([start_rad, end_rad]).share

    def speed_m_s(self, velocity_rad_s: Sequence[float]) -> float:
        return abs(velocity_rad_s[1])

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        raise NotImplementedError

    def rates(
        self, frame: str, twist: Sequence[float], position_rad: Sequence[float], *, tool: bool
    ) -> tuple[float, ...]:
        raise NotImplementedError

    def plan(
        self,
        start_rad: Sequence[float],
        goal_rad: Sequence[float],
        *,
        seed: int = 0,
        within_s: float = 5.0,
        ended: Callable[[], bool] = never,
    ) -> tuple[tuple[float, ...], ...]:
        raise NotImplementedError

"""A fully capable fake robot, the device context around it, and functions that run scripts on it."""

import math
import threading
from collections.abc import Callable, Mapping, Sequence

import msgspec

from device_agent.ports.driver import Observation, Twist
from device_agent.ports.geometry import Clearance, GeometryError, Sweep, never
from device_agent.ports.skills import Skill, SkillError, Stage
from device_agent.protocol import (
    AckStatus,
    Express,
    Pose,
    RunBehaviour,
)
from device_agent.protocol.manifests.robot_type import Base, Gaze, RobotType
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.readings import ReadingCache
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness


class AbleDriver(FakeDriver):
    """A driver that executes and records every skill at once."""

    performs = ("speech", "stiffness", "gaze", "expressions", "behaviours", "postures")

    def __init__(self) -> None:
        super().__init__()
        self.performed: list[Skill] = []
        self.twists: list[Twist] = []
        self.interrupted = threading.Event()

    def drive(self, twist: Twist) -> Twist:
        self.twists.append(twist)
        return twist

    def perform(self, skill: Skill, stage: Stage) -> None:
        self.performed.append(skill)
        match skill:
            case RunBehaviour(name="nod"):
                stage.move_joints({"elbow": 0.1}, 1.0)
            case RunBehaviour(name="too_far"):
                stage.move_joints({"elbow": 99.0}, 1.0)
            case RunBehaviour(name="dance"):
                while not stage.ended:
                    stage.wait(0.01)
                self.interrupted.set()
            case RunBehaviour(name="sulk"):
                stage.wait(60)
                raise SkillError("it broke off")
            case Express(name="frown"):
                raise SkillError("no expression 'frown'; there are smile")


class Head:
    """A geometry: the shoulder turns it left, the elbow turns it up; it looks along its x axis, from 1 m above."""

    frames = ("face",)

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        yaw, pitch = position_rad[0] / 2, -position_rad[1] / 2
        cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
        return {"face": (0.0, 0.0, 1.0, cy * cp, -sy * sp, cy * sp, sy * cp)}

    def clearance(self, position_rad: Sequence[float]) -> Clearance:
        del position_rad
        return Clearance(10.0, ("face", "floor"))

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        del path_rad
        return Sweep(1.0)

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        raise NotImplementedError

    def speed_m_s(self, velocity_rad_s: Sequence[float]) -> float:
        return max(map(abs, velocity_rad_s))

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        del frame, start_rad
        if pose[0] > 1:
            raise GeometryError("face cannot come nearer than 0.5 m")
        return (pose[0], pose[6])

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
        del seed, within_s, ended
        if goal_rad[1] > 1:
            raise GeometryError("found no way there")
        return (tuple(start_rad), (0.0, 0.2), tuple(goal_rad))


def able_type() -> RobotType:
    base = Base(
        max_linear_m_s=0.5,
        max_angular_rad_s=1.0,
        max_linear_acceleration_m_s2=5.0,
        max_angular_acceleration_rad_s2=5.0,
        braking_linear_m_s2=5.0,
        braking_angular_rad_s2=5.0,
    )
    return msgspec.structs.replace(
        robot_type(),
        capabilities=("cartesian", "speech", "stiffness", "expressions", "behaviours", "postures"),
        frames=("face",),
        model="toy.xml",
        base=base,
        gaze=Gaze(frame="face", joints=("shoulder", "elbow")),
    )


def driver_of(harness: DeviceHarness) -> AbleDriver:
    assert isinstance(harness.driver, AbleDriver)
    return harness.driver


def play(harness: DeviceHarness, source: str) -> str:
    """Run the script; it must succeed. Returns what it printed."""
    ack = harness.end(harness.command(harness.script(source), epoch=1))
    assert ack.status is AckStatus.DONE, ack.reason
    return ack.output


def device_context(kind: RobotType, *, measured: bool = True, skills: AbleDriver | None = None) -> DeviceContext:
    observation = Observation((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), ())
    controller = Controller(kind, LeaseGate())
    controller.start_at((0.0, 0.0))
    return DeviceContext(
        robot_type=kind,
        controller=controller,
        observe=lambda: observation if measured else None,
        geometry=None,
        skills=skills,
        readings=ReadingCache(space="s", agent="a", own=["arm"]),
    )

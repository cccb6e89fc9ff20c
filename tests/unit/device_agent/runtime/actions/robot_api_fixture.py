"""A fully capable fake robot, the device context around it, and functions that run scripts on it."""

import math
import threading
from collections.abc import Mapping, Sequence

from device_agent.ports.driver import Observation, Twist
from device_agent.ports.geometry import GeometryError
from device_agent.ports.skills import Skill, SkillContext, SkillError
from device_agent.protocol import Express, Pose, RunBehaviour
from device_agent.protocol.manifests.robot_type import Gaze, RobotType
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.readings import ReadingCache
from tests.fakes.drivers import BASE, FakeDriver, robot_type
from tests.harness.agent.controller_fixture import Wall
from tests.harness.agent.device_harness import DeviceHarness


class CapableDriver(FakeDriver):
    """A driver that executes every skill immediately and records it."""

    performs = ("speech", "stiffness", "gaze", "expressions", "behaviours", "postures")

    def __init__(self) -> None:
        super().__init__()
        self.performed: list[Skill] = []
        self.twists: list[Twist] = []
        self.interrupted = threading.Event()

    def drive(self, twist: Twist) -> Twist:
        self.twists.append(twist)
        return twist

    def perform(self, skill: Skill, context: SkillContext) -> None:
        self.performed.append(skill)
        match skill:
            case RunBehaviour(name="nod"):
                context.move_joints({"elbow": 0.1}, 1.0)
            case RunBehaviour(name="too_far"):
                context.move_joints({"elbow": 99.0}, 1.0)
            case RunBehaviour(name="dance"):
                while not context.ended:
                    context.wait(0.01)
                self.interrupted.set()
            case RunBehaviour(name="sulk"):
                context.wait(60)
                raise SkillError("the skill failed")
            case Express(name="frown"):
                raise SkillError("no expression 'frown'; there are smile")


class Head(Wall):
    """Geometry of a head 1 m above the base. The shoulder turns it left, the elbow up; it views along its x axis."""

    frames = ("face",)

    def __init__(self) -> None:
        super().__init__(at_rad=10.0)

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        yaw, pitch = position_rad[0] / 2, -position_rad[1] / 2
        cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
        return {"face": (0.0, 0.0, 1.0, cy * cp, -sy * sp, cy * sp, sy * cp)}

    def speed_m_s(self, velocity_rad_s: Sequence[float]) -> float:
        return max(map(abs, velocity_rad_s))

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        del frame, start_rad
        if pose[0] > 1:
            raise GeometryError("face cannot come nearer than 0.5 m")
        return (pose[0], pose[6])

    def plan(self, start_rad: Sequence[float], goal_rad: Sequence[float], **_: object) -> tuple[tuple[float, ...], ...]:
        if goal_rad[1] > 1:
            raise GeometryError("found no path there")
        return (tuple(start_rad), (0.0, 0.2), tuple(goal_rad))


def capable_type() -> RobotType:
    return robot_type(
        BASE,
        capabilities=("cartesian", "speech", "stiffness", "expressions", "behaviours", "postures"),
        frames=("face",),
        model="robot.xml",
        gaze=Gaze(frame="face", joints=("shoulder", "elbow")),
    )


def driver_of(harness: DeviceHarness) -> CapableDriver:
    assert isinstance(harness.driver, CapableDriver)
    return harness.driver


def play(harness: DeviceHarness, source: str) -> str:
    """Run the script; it must succeed. Returns what it printed."""
    return harness.done(harness.script(source), epoch=1).output


def device_context(kind: RobotType, *, measured: bool = True, skills: CapableDriver | None = None) -> DeviceContext:
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

"""Robot types and drivers without physics."""

from collections.abc import Sequence
from typing import Any

from device_agent.ports.driver import DriverError, Observation
from device_agent.protocol import Joint, Twin
from device_agent.protocol.manifests.robot_type import Base, RobotType

PERIOD_S = 0.008

BASE = Base(
    max_linear_m_s=0.5,
    max_angular_rad_s=1.0,
    max_linear_acceleration_m_s2=0.8,
    max_angular_acceleration_rad_s2=2.0,
    braking_linear_m_s2=3.0,
    braking_angular_rad_s2=6.0,
)


def joint(name: str, **figures: float) -> Joint:
    defaults = {
        "lower_rad": -3.0,
        "upper_rad": 3.0,
        "max_velocity_rad_s": 3.0,
        "max_acceleration_rad_s2": 8.0,
        "max_jerk_rad_s3": 80.0,
        "max_effort_nm": 100.0,
    }
    return Joint(name=name, label=name, **(defaults | figures))


def robot_type(base: Base | None = None, joints: Sequence[Joint] | None = None, **more: Any) -> RobotType:
    """A robot type with two arm joints by default."""
    joints = tuple(joints or (joint("shoulder"), joint("elbow")))
    defaults: dict[str, Any] = {
        "type": "test",
        "label": "Test",
        "kind": "robot",
        "version": 1,
        "description": "",
        "model": "",
        "scene": "",
        "driver": "none",
        "period_ms": round(PERIOD_S * 1000),
        "frames": (),
        "home_rad": {each.name: 0.0 for each in joints},
        "braking_rad_s2": 20.0,
    }
    return RobotType(**(defaults | {"base": base, "joints": joints} | more))


class FakeDriver:
    """A driver whose joints are at the commanded positions."""

    simulated = True

    def __init__(self) -> None:
        self.position: tuple[float, ...] = (0.0, 0.0)
        self.broken = False
        self.refuses = False
        self.halted = False

    def connect(self) -> None:
        if self.broken:
            raise DriverError("no answer from the arm; is it switched on?")
        self.halted = False

    def twin(self) -> Twin | None:
        return None

    def observe(self) -> Observation:
        if self.broken:
            raise DriverError("no answer from the arm; is it switched on?")
        return Observation(self.position, (0.0, 0.0), (0.0, 0.0), ())

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        if self.refuses or self.halted:
            raise DriverError("no")
        self.position = tuple(position_rad)
        return self.position

    def halt(self) -> None:
        self.halted = True

    def close(self) -> None:
        pass

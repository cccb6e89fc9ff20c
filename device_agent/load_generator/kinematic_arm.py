"""A kinematic arm without dynamics: joints move at constant speed and stop at once."""

import math
from collections.abc import Sequence

from device_agent.protocol import Joint, Stream, topics
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control.limits import MotionLimits

DEVICE = "arm"
RANGE_RAD = math.pi
SPEED_RAD_S = 1.5


def robot_type(name: str, joints: int, rate_hz: float) -> RobotType:
    """Robot type of all simulated arms, with equal joints."""
    names = [f"joint_{number}" for number in range(1, joints + 1)]
    return RobotType(
        type=name,
        label=f"Arm of a swarm, {joints} joints",
        kind="arm",
        version=1,
        description="Only figures: no mass, no shape.",
        model="",
        scene="",
        driver="load-generator",
        period_ms=20,
        joints=tuple(
            Joint(
                name=each,
                label=each.replace("_", " ").capitalize(),
                lower_rad=-RANGE_RAD,
                upper_rad=RANGE_RAD,
                max_velocity_rad_s=SPEED_RAD_S,
                max_acceleration_rad_s2=6.0,
                max_jerk_rad_s3=60.0,
                max_effort_nm=10.0,
            )
            for each in names
        ),
        frames=(),
        home_rad=dict.fromkeys(names, 0.0),
        braking_rad_s2=12.0,
        streaming_speed=1.0,
        capabilities=("joints",),
        streams=(Stream(name=topics.JOINTS, rate_hz=rate_hz),),
    )


class Shape:
    """Properties that all simulated arms share.

    Attributes:
        kind: Their type.
        envelope: Where joints may be: the real agent's own code, without a shape to collide with.
        speeds_rad_s: How fast each joint turns at most, shape (n,).
    """

    def __init__(self, kind: RobotType) -> None:
        self.kind = kind
        self.envelope = MotionLimits(kind, None)
        self.speeds_rad_s = tuple(joint.max_velocity_rad_s for joint in kind.joints)


class Arm:
    """One arm. Callers provide the time.

    Attributes:
        position_rad: Where it is, shape (n,).
        velocity_rad_s: How fast it turned when it was last looked at, shape (n,).
        target_rad: Where it is going, shape (n,).
    """

    __slots__ = ("_at_s", "_most_rad_s", "_speed", "_until_s", "position_rad", "target_rad", "velocity_rad_s")

    def __init__(self, shape: Shape, now_s: float) -> None:
        self.position_rad = [shape.kind.home_rad[joint.name] for joint in shape.kind.joints]
        self.target_rad = list(self.position_rad)
        self.velocity_rad_s = [0.0] * len(self.position_rad)
        self._most_rad_s = shape.speeds_rad_s
        self._speed = 0.0
        self._at_s = now_s
        self._until_s = math.inf

    @property
    def arrived(self) -> bool:
        """Whether the arm has reached its target."""
        return self.position_rad == self.target_rad

    def go(self, target_rad: Sequence[float], *, speed: float, until_s: float = math.inf) -> None:
        """Move towards a target, shape (n,) [rad], with a share of the joint speed, until a time at most [s]."""
        self.target_rad = list(target_rad)
        self._speed = speed
        self._until_s = until_s

    def hold(self) -> None:
        """Stop at once."""
        self.target_rad = list(self.position_rad)

    def advance(self, now_s: float) -> None:
        """Advance the joints to the current time."""
        moving_s = max(0.0, min(now_s, self._until_s) - self._at_s)
        passed_s = now_s - self._at_s
        self._at_s = now_s
        if passed_s <= 0:
            return
        for index, target in enumerate(self.target_rad):
            here = self.position_rad[index]
            if here == target:
                self.velocity_rad_s[index] = 0.0
                continue
            step = self._most_rad_s[index] * self._speed * moving_s
            there = target if abs(target - here) <= step else here + math.copysign(step, target - here)
            self.position_rad[index] = there
            self.velocity_rad_s[index] = (there - here) / passed_s
        if now_s >= self._until_s:
            self.hold()
            self.velocity_rad_s = [0.0] * len(self.position_rad)

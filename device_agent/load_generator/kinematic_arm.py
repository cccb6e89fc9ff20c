"""A kinematic arm without dynamics: joints move at constant speed and stop immediately."""

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
        label=f"Load-test arm, {joints} joints",
        kind="arm",
        version=1,
        description="Kinematic only: without mass and shape.",
        model="",
        scene="",
        driver="load-generator",
        period_ms=20,
        joints=tuple(
            Joint(
                name=joint,
                label=joint.replace("_", " ").capitalize(),
                lower_rad=-RANGE_RAD,
                upper_rad=RANGE_RAD,
                max_velocity_rad_s=SPEED_RAD_S,
                max_acceleration_rad_s2=6.0,
                max_jerk_rad_s3=60.0,
                max_effort_nm=10.0,
            )
            for joint in names
        ),
        frames=(),
        home_rad=dict.fromkeys(names, 0.0),
        braking_rad_s2=12.0,
        streaming_speed=1.0,
        capabilities=("joints",),
        streams=(Stream(name=topics.JOINTS, rate_hz=rate_hz),),
    )


class ArmType:
    """Properties that all simulated arms share.

    Attributes:
        robot_type: Robot type of all arms.
        limits: Position limits of the real agent, without collision checks.
        max_velocity_rad_s: Maximum velocity of each joint, shape (n,).
    """

    def __init__(self, robot_type: RobotType) -> None:
        self.robot_type = robot_type
        self.limits = MotionLimits(robot_type, None)
        self.max_velocity_rad_s = tuple(joint.max_velocity_rad_s for joint in robot_type.joints)


class Arm:
    """One arm. Callers provide the time.

    Attributes:
        position_rad: Current positions, shape (n,).
        velocity_rad_s: Mean velocities between the last two updates, shape (n,).
        target_rad: Target positions, shape (n,).
    """

    __slots__ = ("_at_s", "_max_velocity_rad_s", "_speed", "_until_s", "position_rad", "target_rad", "velocity_rad_s")

    def __init__(self, arm_type: ArmType, now_s: float) -> None:
        self.position_rad = [arm_type.robot_type.home_rad[joint.name] for joint in arm_type.robot_type.joints]
        self.target_rad = list(self.position_rad)
        self.velocity_rad_s = [0.0] * len(self.position_rad)
        self._max_velocity_rad_s = arm_type.max_velocity_rad_s
        self._speed = 0.0
        self._at_s = now_s
        self._until_s = math.inf

    @property
    def arrived(self) -> bool:
        """Whether the arm has reached its target."""
        return self.position_rad == self.target_rad

    def move(self, target_rad: Sequence[float], *, speed: float, until_s: float = math.inf) -> None:
        """Move towards a target, shape (n,) [rad], at a share of the joint speed; stop at ``until_s`` [s]."""
        self.target_rad = list(target_rad)
        self._speed = speed
        self._until_s = until_s

    def hold(self) -> None:
        """Stop immediately."""
        self.target_rad = list(self.position_rad)

    def advance(self, now_s: float) -> None:
        """Advance the joints to the current time."""
        moving_s = max(0.0, min(now_s, self._until_s) - self._at_s)
        elapsed_s = now_s - self._at_s
        self._at_s = now_s
        if elapsed_s <= 0:
            return
        for index, target in enumerate(self.target_rad):
            position = self.position_rad[index]
            if position == target:
                self.velocity_rad_s[index] = 0.0
                continue
            step = self._max_velocity_rad_s[index] * self._speed * moving_s
            reached = target if abs(target - position) <= step else position + math.copysign(step, target - position)
            self.position_rad[index] = reached
            self.velocity_rad_s[index] = (reached - position) / elapsed_s
        if now_s >= self._until_s:
            self.hold()
            self.velocity_rad_s = [0.0] * len(self.position_rad)

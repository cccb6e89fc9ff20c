"""A simulated head: pitch limits depend on yaw, and the right ear mirrors the left ear."""

from device_agent.protocol.manifests.capabilities import MimicJoint, PositionDependentLimit
from device_agent.protocol.manifests.robot_type import RobotType
from tests.fakes import drivers

PERIOD_S = 0.02
NAMES = ("yaw", "pitch", "left", "right")
RANGES = ((-2.0, 2.0), (-0.7, 0.5), (-1.0, 0.5), (-0.25, 0.5))
SPEED = 4.0
FACTOR = -0.5
WIDE = ((-2.0, -0.4, 0.1), (-0.5, -0.7, 0.5), (0.5, -0.7, 0.5), (2.0, -0.4, 0.1))
BENT = ((-2.0, -0.7, -0.3), (-0.4, -0.5, 0.1), (0.4, -0.2, 0.3), (2.0, 0.2, 0.5))
"""No pitch is valid for every yaw."""


def head(table: tuple[tuple[float, float, float], ...] = WIDE) -> RobotType:
    figures = {
        "max_velocity_rad_s": SPEED,
        "max_acceleration_rad_s2": 10.0,
        "max_jerk_rad_s3": 100.0,
        "max_effort_nm": 5.0,
    }
    return drivers.robot_type(
        joints=[
            drivers.joint(name, lower_rad=lower, upper_rad=upper, **figures)
            for name, (lower, upper) in zip(NAMES, RANGES, strict=True)
        ],
        type="head",
        label="Head",
        period_ms=round(PERIOD_S * 1000),
        braking_rad_s2=25.0,
        streaming_speed=1.0,
        mimic_joints=(MimicJoint(joint="right", mimics="left", multiplier=FACTOR),),
        position_dependent_limits=(PositionDependentLimit(joint="pitch", depends_on="yaw", table=table),),
    )

"""Robot types for tests, as users make them for robots that do not ship."""

from msgspec.structs import replace

from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import Base, RobotType
from tests.harness.paths import ROBOTS


def lekiwi() -> RobotType:
    """The SO-101 on LeKiwi's base, without a model."""
    arm = robot_type.load(ROBOTS / "so101")
    return replace(
        arm,
        type="lekiwi",
        model="",
        frames=(),
        workspace=None,
        joints=tuple(replace(joint, name=f"arm_{joint.name}") for joint in arm.joints),
        home_rad={f"arm_{name}": value for name, value in arm.home_rad.items()},
        base=Base(
            max_linear_m_s=0.3,
            max_angular_rad_s=1.5,
            max_linear_acceleration_m_s2=1.0,
            max_angular_acceleration_rad_s2=3.0,
            braking_linear_m_s2=2.0,
            braking_angular_rad_s2=6.0,
            sideways=True,
        ),
    )

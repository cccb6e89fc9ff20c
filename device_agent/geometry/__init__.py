"""What is known of a robot's shape: from its model, in MuJoCo, without stepping any physics."""

from pathlib import Path

from device_agent.ports.geometry import Geometry, GeometryError
from device_agent.protocol.robot_type import RobotType

__all__ = ["load"]


def load(robot_type: RobotType, folder: Path, *, scene: str = "") -> Geometry | None:
    """The geometry of a robot type; ``None`` where its manifest names no model.

    Args:
        robot_type: The manifest.
        folder: The robot type's folder.
        scene: MJCF file of what stands around the robot instead of the manifest's, relative to the folder.

    Raises:
        GeometryError: The model cannot be read or does not fit the manifest, or MuJoCo is not installed.
    """
    if not robot_type.model:
        return None
    try:
        from device_agent.geometry.model import MujocoGeometry  # noqa: PLC0415 (agents without a model need no MuJoCo)
    except ImportError as error:
        raise GeometryError(
            f"'{robot_type.type}' has a model, and nothing here can read it ({error}); install mujoco-core"
        ) from error
    return MujocoGeometry(robot_type, folder / (scene or robot_type.scene or robot_type.model))

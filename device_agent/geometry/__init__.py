"""What is known of a robot's shape: from its model, in MuJoCo, without stepping any physics."""

from pathlib import Path

from device_agent.geometry.base_pose import BasePose
from device_agent.ports.geometry import GeometryError, RobotGeometry
from device_agent.protocol.manifests.robot_type import RobotType

__all__ = ["BasePose", "load"]


def load(
    robot_type: RobotType, folder: Path, *, scene: str = "", standing: BasePose | None = None
) -> RobotGeometry | None:
    """The geometry of a robot type; ``None`` where its manifest names no model.

    Args:
        robot_type: The manifest.
        folder: The robot type's folder.
        scene: MJCF file of what stands around the robot instead of the manifest's, relative to the folder.
        standing: The room that it stands in and where, instead of a scene.

    Raises:
        GeometryError: The model cannot be read or does not fit the manifest, or MuJoCo is not installed.
    """
    if not robot_type.model:
        return None
    try:
        from device_agent.geometry.mujoco_geometry import MujocoGeometry  # noqa: PLC0415 (agents without a model need no MuJoCo)
    except ImportError as error:
        raise GeometryError(
            f"'{robot_type.type}' has a model, and nothing here can read it ({error}); install mujoco-core"
        ) from error
    if standing is not None:
        return MujocoGeometry(robot_type, folder / robot_type.model, standing=standing)
    return MujocoGeometry(robot_type, folder / (scene or robot_type.scene or robot_type.model))

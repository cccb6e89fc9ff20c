"""Robot geometry from MuJoCo models, without physics: poses, clearance, IK, planning."""

from pathlib import Path

from device_agent.geometry.base_pose import BasePose
from device_agent.ports.geometry import GeometryError, RobotGeometry
from device_agent.protocol.manifests.robot_type import RobotType

__all__ = ["BasePose", "load"]


def load(
    robot_type: RobotType, folder: Path, *, scene: str = "", base_pose: BasePose | None = None
) -> RobotGeometry | None:
    """The geometry of a robot type; ``None`` if its manifest names no model.

    Args:
        robot_type: The manifest.
        folder: The robot type's folder.
        scene: MJCF file to use instead of the manifest's scene, relative to the folder.
        base_pose: The room and the robot's pose in it, instead of a scene.

    Raises:
        GeometryError: The model cannot be read or does not match the manifest, or MuJoCo is not installed.
    """
    if not robot_type.model:
        return None
    try:
        from device_agent.geometry.mujoco_geometry import MujocoGeometry  # noqa: PLC0415 (agents without a model need no MuJoCo)
    except ImportError as error:
        raise GeometryError(
            f"'{robot_type.type}' has a model, but MuJoCo is not installed ({error}); install mujoco-core"
        ) from error
    if base_pose is not None:
        return MujocoGeometry(robot_type, folder / robot_type.model, base_pose=base_pose)
    return MujocoGeometry(robot_type, folder / (scene or robot_type.scene or robot_type.model))

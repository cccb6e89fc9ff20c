"""Render a robot type's scene: ``python robots/render.py ur5 docs/pictures/ur5.png``.

The robot is at home by default. Pose it with ``joint=position`` [rad], ``--expression happy``, ``--posture Sit`` or
``--viseme aa``, and place an object of the scene with ``object=x,y,z`` [m]. The default camera is the scene's
``picture``; ``--camera`` selects another.

Contact sheets: ``--turntable`` shows the robot from all sides, ``--all expressions`` all expressions of the manifest.

Requires a software renderer (Debian: ``libosmesa6``), but no display.
"""  # noqa: INP001 - a script, not a package

import argparse
import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

sys.path.insert(0, str(Path(__file__).parent.parent))
os.environ.setdefault("MUJOCO_GL", "osmesa")
os.environ.setdefault("PYOPENGL_PLATFORM", "osmesa")

import mujoco
import numpy as np

from device_agent.config import catalogue
from device_agent.protocol.manifests import robot_type
from device_agent.sensors import png
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

WIDTH, HEIGHT, CAMERA = 800, 600, "picture"
TILE = 180
VIEWS = 8
POSES = ("expressions", "postures", "visemes")


class SceneRenderer:
    """One robot type's scene and a renderer; use it as a context manager.

    Args:
        folder: The robot type's folder.
        width: Image width [px]; ``height`` likewise.
    """

    def __init__(self, folder: Path, width: int, height: int) -> None:
        self.manifest = robot_type.load(folder)
        self.model = mujoco.MjModel.from_xml_path(str(folder / self.manifest.scene))
        self.data = mujoco.MjData(self.model)
        self._equality_joints = EqualityJoints(self.model)
        drawing = self.model.vis.global_
        drawing.offwidth, drawing.offheight = max(drawing.offwidth, width), max(drawing.offheight, height)
        self._renderer = mujoco.Renderer(self.model, height, width)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def joints_of(self, kind: str, name: str) -> dict[str, float]:
        """Joint positions [rad] of an expression, posture or viseme."""
        poses: Mapping[str, Mapping[str, float]] = getattr(self.manifest, kind, {})
        if name not in poses:
            sys.exit(f"{self.manifest.type} has no '{name}' in {kind}; available: {', '.join(poses) or 'none'}")
        return dict(poses[name])

    def pose(self, position_rad: Mapping[str, float | Sequence[float]]) -> None:
        """Set joint positions, or x, y, z [m] of objects; other joints are at home."""
        for joint, position in (self.manifest.home_rad | dict(position_rad)).items():
            values = np.atleast_1d(position)
            self.data.joint(joint).qpos[: len(values)] = values
        self._equality_joints.apply(self.data.qpos)
        mujoco.mj_forward(self.model, self.data)

    def render(self, camera: Any) -> Any:
        """The view of a camera, shape (height, width, 3), 8 bits per channel."""
        self._renderer.update_scene(self.data, camera)
        return self._renderer.render()

    def orbit_camera(self, azimuth_rad: float) -> Any:
        """A camera that looks at the scene's centre from this direction."""
        camera = mujoco.MjvCamera()
        camera.lookat[:] = self.model.stat.center
        camera.distance = 2.2 * self.model.stat.extent
        camera.azimuth, camera.elevation = math.degrees(azimuth_rad), -12
        return camera


def sheet(images: Sequence[Any]) -> Any:
    """A contact sheet of equally sized images, about square."""
    columns = math.ceil(math.sqrt(len(images)))
    blank = np.full_like(images[0], 255)
    filled = [*images, *[blank] * (-len(images) % columns)]
    rows = [np.concatenate(filled[start : start + columns], axis=1) for start in range(0, len(filled), columns)]
    return np.concatenate(rows, axis=0)


def main() -> None:
    """Command line."""
    types = catalogue.TYPES.folders()
    parser = argparse.ArgumentParser(description="Render a robot type's scene.")
    parser.add_argument("type", choices=sorted(types))
    parser.add_argument("file", type=Path)
    parser.add_argument("position", nargs="*", metavar="joint=position", help="[rad]; other joints are at home")
    parser.add_argument("--expression", help="name in the manifest")
    parser.add_argument("--posture", help="name in the manifest")
    parser.add_argument("--viseme", help="name in the manifest")
    parser.add_argument("--camera", default=CAMERA, help="camera of the scene (default: %(default)s)")
    parser.add_argument("--turntable", action="store_true", help="eight views around the robot")
    parser.add_argument("--all", choices=POSES, help="one image for each in the manifest")
    arguments = parser.parse_args()
    single = not (arguments.turntable or arguments.all)
    width, height = (WIDTH, HEIGHT) if single else (TILE, TILE)
    with SceneRenderer(types[arguments.type], width, height) as scene:
        position_rad: dict[str, float | Sequence[float]] = {}
        for kind in POSES:
            name = getattr(arguments, kind.removesuffix("s"))
            position_rad |= scene.joints_of(kind, name) if name else {}
        for joint, _, at in (text.partition("=") for text in arguments.position):
            position_rad[joint] = [float(value) for value in at.split(",")]
        scene.pose(position_rad)
        if arguments.turntable:
            image = sheet([scene.render(scene.orbit_camera(2 * math.pi * view / VIEWS)) for view in range(VIEWS)])
        elif arguments.all:
            images = []
            for name in getattr(scene.manifest, arguments.all):
                scene.pose(scene.joints_of(arguments.all, name) | position_rad)
                images.append(scene.render(arguments.camera))
            image = sheet(images)
        else:
            image = scene.render(arguments.camera)
    arguments.file.write_bytes(png.encode(image))


if __name__ == "__main__":
    main()

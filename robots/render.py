"""Draw a robot type's scene: ``python robots/render.py ur5 docs/pictures/ur5.png``.

At home, unless told otherwise: ``joint=position`` [rad], ``--expression happy``, ``--posture Sit``, ``--viseme aa``.
Looks through the scene's camera ``picture``, unless ``--camera`` names another.

Sheets of several pictures: ``--turntable`` goes round the robot, ``--all expressions`` shows all that the manifest has.

Needs a software renderer (Debian: ``libosmesa6``), no display.
"""  # noqa: INP001 - a script beside the folders it draws, not a package

import argparse
import math
import os
import struct
import sys
import zlib
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
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

WIDTH, HEIGHT, CAMERA = 800, 600, "picture"
TILE = 180
VIEWS = 8
POSES = ("expressions", "postures", "visemes")


class Studio:
    """One robot type's scene, and a renderer. Use as ``with Studio(folder, size) as studio``.

    Args:
        folder: The robot type's folder.
        width: Of a picture; ``height`` likewise.
    """

    def __init__(self, folder: Path, width: int, height: int) -> None:
        self.manifest = robot_type.load(folder)
        self.model = mujoco.MjModel.from_xml_path(str(folder / self.manifest.scene))
        self.data = mujoco.MjData(self.model)
        self._ties = EqualityJoints(self.model)
        drawing = self.model.vis.global_
        drawing.offwidth, drawing.offheight = max(drawing.offwidth, width), max(drawing.offheight, height)
        self._renderer = mujoco.Renderer(self.model, height, width)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def named(self, kind: str, name: str) -> dict[str, float]:
        """The joints [rad] of an expression, posture or viseme."""
        known: Mapping[str, Mapping[str, float]] = getattr(self.manifest, kind, {})
        if name not in known:
            sys.exit(f"{self.manifest.type} has no '{name}' in its {kind}; it has: {', '.join(known) or 'none'}")
        return dict(known[name])

    def pose(self, position_rad: Mapping[str, float]) -> None:
        """Put the robot somewhere; joints not named are at home."""
        for joint, position in (self.manifest.home_rad | dict(position_rad)).items():
            self.data.joint(joint).qpos[0] = position
        self._ties.settle(self.data.qpos)
        mujoco.mj_forward(self.model, self.data)

    def picture(self, camera: Any) -> Any:
        """What a camera sees, shape (height, width, 3), 8 bits a colour."""
        self._renderer.update_scene(self.data, camera)
        return self._renderer.render()

    def round(self, azimuth_rad: float) -> Any:
        """A camera somewhere around the robot, as far away as the scene says."""
        camera = mujoco.MjvCamera()
        camera.lookat[:] = self.model.stat.center
        camera.distance = 2.2 * self.model.stat.extent
        camera.azimuth, camera.elevation = math.degrees(azimuth_rad), -12
        return camera


def sheet(pictures: Sequence[Any]) -> Any:
    """Pictures of one size side by side, in about as many rows as columns."""
    columns = math.ceil(math.sqrt(len(pictures)))
    blank = np.full_like(pictures[0], 255)
    filled = [*pictures, *[blank] * (-len(pictures) % columns)]
    rows = [np.concatenate(filled[start : start + columns], axis=1) for start in range(0, len(filled), columns)]
    return np.concatenate(rows, axis=0)


def png(image: Any) -> bytes:
    """An image as PNG: signature, header, one compressed block of rows, end.

    Each row is written as what it differs from the one above (filter 2), which is little in a drawing.
    """
    height, width, _ = image.shape
    above = np.vstack([np.zeros_like(image[:1]), image[:-1]])
    rows = b"".join(b"\2" + row.tobytes() for row in (image - above))
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in parts
    )


def main() -> None:
    """Command line."""
    types = catalogue.TYPES.folders()
    parser = argparse.ArgumentParser(description="Draw a robot type's scene.")
    parser.add_argument("type", choices=sorted(types))
    parser.add_argument("file", type=Path)
    parser.add_argument("position", nargs="*", metavar="joint=position", help="[rad]; the others are at home")
    parser.add_argument("--expression", help="one of the manifest's")
    parser.add_argument("--posture", help="one of the manifest's")
    parser.add_argument("--viseme", help="one of the manifest's")
    parser.add_argument("--camera", default=CAMERA, help="of the scene (default: %(default)s)")
    parser.add_argument("--turntable", action="store_true", help="eight views, from all around")
    parser.add_argument("--all", choices=POSES, help="a picture of each that the manifest has, in its order")
    arguments = parser.parse_args()
    single = not (arguments.turntable or arguments.all)
    width, height = (WIDTH, HEIGHT) if single else (TILE, TILE)
    with Studio(types[arguments.type], width, height) as studio:
        position_rad: dict[str, float] = {}
        for kind in POSES:
            name = getattr(arguments, kind.removesuffix("s"))
            position_rad |= studio.named(kind, name) if name else {}
        position_rad |= {joint: float(at) for joint, _, at in (text.partition("=") for text in arguments.position)}
        studio.pose(position_rad)
        if arguments.turntable:
            image = sheet([studio.picture(studio.round(2 * math.pi * view / VIEWS)) for view in range(VIEWS)])
        elif arguments.all:
            pictures = []
            for name in getattr(studio.manifest, arguments.all):
                studio.pose(studio.named(arguments.all, name) | position_rad)
                pictures.append(studio.picture(arguments.camera))
            image = sheet(pictures)
        else:
            image = studio.picture(arguments.camera)
    arguments.file.write_bytes(png(image))


if __name__ == "__main__":
    main()

"""Draw a robot type's scene at home: ``python robots/render.py ur5 docs/pictures/ur5.png``.

With ``joint=position`` behind it [rad], elsewhere: ``… ur5 docs/pictures/held.png shoulder_lift=-0.881``.

Looks through the scene's camera ``picture``. Needs a software renderer (Debian: ``libosmesa6``), no display.
"""  # noqa: INP001 - a script beside the folders it draws, not a package

import argparse
import os
import struct
import sys
import zlib
from pathlib import Path
from typing import Any

ROBOTS = Path(__file__).parent
sys.path.insert(0, str(ROBOTS.parent))
os.environ.setdefault("MUJOCO_GL", "osmesa")
os.environ.setdefault("PYOPENGL_PLATFORM", "osmesa")

import mujoco  # noqa: E402 - reads MUJOCO_GL when imported

from device_agent.protocol import robot_type  # noqa: E402

WIDTH, HEIGHT, CAMERA = 800, 600, "picture"


def render(name: str, position_rad: dict[str, float]) -> Any:
    """The picture of a robot type, shape (height, width, 3), 8 bits a colour; joints not named are at home."""
    manifest = robot_type.load(ROBOTS / name)
    model = mujoco.MjModel.from_xml_path(str(ROBOTS / name / manifest.scene))
    data = mujoco.MjData(model)
    for joint, position in (manifest.home_rad | position_rad).items():
        data.joint(joint).qpos[0] = position
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, CAMERA)
        return renderer.render()


def png(image: Any) -> bytes:
    """An image as PNG: signature, header, one compressed block of rows without filter, end."""
    height, width, _ = image.shape
    rows = b"".join(b"\0" + row.tobytes() for row in image)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in parts
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Draw a robot type's scene at home.")
    parser.add_argument("type", choices=sorted(path.parent.name for path in ROBOTS.glob("*/robot.toml")))
    parser.add_argument("file", type=Path)
    parser.add_argument("position", nargs="*", metavar="joint=position")
    arguments = parser.parse_args()
    named = (text.partition("=") for text in arguments.position)
    position_rad = {joint: float(position) for joint, _, position in named}
    arguments.file.write_bytes(png(render(arguments.type, position_rad)))


if __name__ == "__main__":
    main()

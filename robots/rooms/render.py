"""Draw a room as one of its cameras sees it: ``python robots/rooms/render.py lab camera docs/pictures/lab-camera.png``.

With a number behind it, after so many seconds; with ``name=value`` behind that, with that set, as in
``… lab pan_tilt door.png 6 door=1.2 lamp=0``. Needs a software renderer (Debian: ``libosmesa6``), no display.
"""  # noqa: INP001 - a script beside the folders it draws, not a package

import argparse
import sys
from pathlib import Path
from typing import Any

ROOMS = Path(__file__).parent
sys.path.insert(0, str(ROOMS.parent))

import render  # noqa: E402 - also chooses the software renderer, before MuJoCo is imported

sys.path.insert(0, str(ROOMS.parent.parent))

import mujoco  # noqa: E402

from device_agent.simulation import world_registry  # noqa: E402
from device_agent.simulation.scene_assembly import TIMESTEP_S  # noqa: E402

WIDTH, HEIGHT = 480, 360


def draw(name: str, camera: str, *, after_s: float, settings: dict[str, float]) -> Any:
    """The picture, shape (height, width, 3), 8 bits a colour."""
    world = world_registry.of(ROOMS / name)
    world.build()
    for what, value in settings.items():
        world.set(what, value)
    if after_s > 0:
        world.step(round(after_s / TIMESTEP_S))
    data = mujoco.MjData(world.model)
    world.copy(data)
    with mujoco.Renderer(world.model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Draw a room as one of its cameras sees it.")
    parser.add_argument("room", choices=sorted(path.parent.name for path in ROOMS.glob("*/room.toml")))
    parser.add_argument("camera")
    parser.add_argument("file", type=Path)
    parser.add_argument("after_s", type=float, nargs="?", default=0.0)
    parser.add_argument("setting", nargs="*", metavar="name=value")
    arguments = parser.parse_args()
    settings = {name: float(value) for name, _, value in (text.partition("=") for text in arguments.setting)}
    picture = draw(arguments.room, arguments.camera, after_s=arguments.after_s, settings=settings)
    arguments.file.write_bytes(render.png(picture))


if __name__ == "__main__":
    main()

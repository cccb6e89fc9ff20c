"""Render the view of a room's camera: ``python robots/rooms/render.py lab camera docs/pictures/lab-camera.png``.

Optional arguments: simulated time [s], then settings, as in ``… lab pan_tilt door.png 6 door=1.2 lamp=0``. Requires a
software renderer (Debian: ``libosmesa6``), but no display.
"""  # noqa: INP001 - a script, not a package

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
    """The image, shape (height, width, 3), 8 bits per channel."""
    world = world_registry.get_world(ROOMS / name)
    world.build()
    for setting, value in settings.items():
        world.set(setting, value)
    if after_s > 0:
        world.step(round(after_s / TIMESTEP_S))
    data = mujoco.MjData(world.model)
    world.copy(data)
    with mujoco.Renderer(world.model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Render the view of a room's camera.")
    parser.add_argument("room", choices=sorted(path.parent.name for path in ROOMS.glob("*/room.toml")))
    parser.add_argument("camera")
    parser.add_argument("file", type=Path)
    parser.add_argument("after_s", type=float, nargs="?", default=0.0)
    parser.add_argument("setting", nargs="*", metavar="name=value")
    arguments = parser.parse_args()
    settings = {name: float(value) for name, _, value in (text.partition("=") for text in arguments.setting)}
    image = draw(arguments.room, arguments.camera, after_s=arguments.after_s, settings=settings)
    arguments.file.write_bytes(render.png.encode(image))


if __name__ == "__main__":
    main()

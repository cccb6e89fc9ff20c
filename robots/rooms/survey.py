"""Record the background model of a simulated room: ``python robots/rooms/survey.py lab``.

Writes the file that the options of the room's perception device name. Repeat it after moving furniture, a lidar or a
depth camera. In a real room, use the capture ``survey`` of the perception device.
"""  # noqa: INP001 - a script, not a package

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOMS = Path(__file__).parent
sys.path.insert(0, str(ROOMS.parent.parent))

import msgspec  # noqa: E402

from device_agent import sensors  # noqa: E402
from device_agent.ports.sensor import RoomDriver, Surroundings  # noqa: E402
from device_agent.protocol.manifests import room  # noqa: E402
from device_agent.simulation import world_registry  # noqa: E402

SETTLE_S = 4.0
"""Time for blinds, door and cameras to reach their start positions [s]."""
_AWAY_M = -50.0


class EmptyRoom:
    """A process that moves all mocap bodies out of the room."""

    def step(self, model: Any, data: Any, time_s: float) -> None:  # noqa: ARG002 - see ``Process``
        """See ``Process``."""
        data.mocap_pos[:, 2] = _AWAY_M


def survey(name: str) -> tuple[Path, bytes]:
    """Path and content of a room's background model."""
    folder = ROOMS / name
    manifest = room.load(folder)
    device = next((entry for entry in manifest.devices if entry.driver == "perception"), None)
    if device is None or not device.options.get("survey"):
        sys.exit(f"room '{name}' has no device with the driver 'perception' with the option 'survey'")
    options = {**device.options, "survey": "", "mounts": []}
    world = world_registry.make(msgspec.structs.replace(manifest, robots=(), people=()), folder, {})
    world.add(EmptyRoom())
    neighbours: dict[str, RoomDriver] = {}
    surroundings = Surroundings(neighbours=neighbours, world=world)
    for entry in manifest.devices:
        if entry.name in _sensor_names(options):
            neighbours[entry.name] = sensors.load(entry.driver)(entry, folder, surroundings)
    perception = sensors.load("perception")(
        msgspec.structs.replace(device, options={**options, "light": ""}), folder, surroundings
    )
    for driver in (*neighbours.values(), perception):
        driver.connect()
    try:
        time.sleep(SETTLE_S)
        return folder / str(device.options["survey"]), perception.capture("survey").content
    finally:
        for driver in (perception, *neighbours.values()):
            driver.close()


def _sensor_names(options: Mapping[str, Any]) -> set[str]:
    return {*options.get("lidars", ()), *options.get("cameras", ())}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Record the background model of a simulated room.")
    parser.add_argument("room", choices=sorted(path.parent.name for path in ROOMS.glob("*/room.toml")))
    path, content = survey(parser.parse_args().room)
    path.write_bytes(content)
    sys.stdout.write(f"{path}: {len(content)} bytes\n")


if __name__ == "__main__":
    main()

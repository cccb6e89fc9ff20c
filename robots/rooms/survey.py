"""Survey a simulated room as its own sensors see it empty: ``python robots/rooms/survey.py lab``.

Writes the file that the options of the room's perception name. Take a new one whenever the furniture, a lidar or a
depth camera has moved. A real room is surveyed by the capture ``survey`` of its perception.
"""  # noqa: INP001 - a script beside the folders it writes to, not a package

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
"""Blinds, door and cameras take that long to where they start [s]."""
_AWAY_M = -50.0


class Nobody:
    """A process that takes all who are moved by hand out of the room."""

    def step(self, model: Any, data: Any, time_s: float) -> None:  # noqa: ARG002 - see ``Process``
        """See ``Process``."""
        data.mocap_pos[:, 2] = _AWAY_M


def survey(name: str) -> tuple[Path, bytes]:
    """The file of a room's survey, and what belongs into it."""
    folder = ROOMS / name
    manifest = room.load(folder)
    device = next((one for one in manifest.devices if one.driver == "perception"), None)
    if device is None or not device.options.get("survey"):
        sys.exit(f"room '{name}' has no device with the driver 'perception' whose options name a survey")
    options = {**device.options, "survey": "", "mounts": []}
    world = world_registry.make(msgspec.structs.replace(manifest, robots=(), people=()), folder, {})
    world.add(Nobody())
    neighbours: dict[str, RoomDriver] = {}
    surroundings = Surroundings(neighbours=neighbours, world=world)
    for one in manifest.devices:
        if one.name in _eyes(options):
            neighbours[one.name] = sensors.load(one.driver)(one, folder, surroundings)
    eye = sensors.load("perception")(
        msgspec.structs.replace(device, options={**options, "light": ""}), folder, surroundings
    )
    for driver in (*neighbours.values(), eye):
        driver.connect()
    try:
        time.sleep(SETTLE_S)
        return folder / str(device.options["survey"]), eye.capture("survey").content
    finally:
        for driver in (eye, *neighbours.values()):
            driver.close()


def _eyes(options: Mapping[str, Any]) -> set[str]:
    return {*options.get("lidars", ()), *options.get("cameras", ())}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Survey a simulated room as its own sensors see it empty.")
    parser.add_argument("room", choices=sorted(path.parent.name for path in ROOMS.glob("*/room.toml")))
    path, content = survey(parser.parse_args().room)
    path.write_bytes(content)
    sys.stdout.write(f"{path}: {len(content)} bytes\n")


if __name__ == "__main__":
    main()

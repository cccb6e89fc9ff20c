"""List all devices and run a movement on one. Usage: ``python examples/list_and_move.py DEVICE MOVEMENT``."""

import sys

from telescope_client import call, find_device

name, movement = sys.argv[1:]
for device in call("GET", "/devices")["items"]:
    print(device["name"], "online" if device["online"] else "offline")

action = call(
    "POST",
    f"/devices/{find_device(name)['id']}/actions",
    {"request": {"kind": "run_movement", "name": movement}, "wait_ms": 30_000, "wait_for": "done"},
)
print(f"{movement}: {action['status']}")

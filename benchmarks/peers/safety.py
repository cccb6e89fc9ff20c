"""Safety functions that each compared protocol provides, and those that it leaves to the application."""

from typing import Final

from benchmarks.reporting.report import Table

COLUMNS: Final = ["", "Telescope", "rosbridge", "zenoh", "gRPC (Viam)", "Foxglove"]
_ROWS: Final = (
    (
        "permission to publish",
        "short-lived credentials for the topics of one device",
        "all topics, or a list",
        "access control lists",
        "API keys, roles",
        "every connected client",
    ),
    ("one controller", "a lease with an epoch that the robot checks", "–", "–", "–", "–"),
    ("loss of commands", "holds after 300 ms", "–", "–", "stops after 2 s", "–"),
    ("late setpoints", "rejected if the loop age exceeds 200 ms", "–", "–", "–", "–"),
    ("limits", "position, velocity, acceleration, workspace, self-collision", "–", "–", "–", "–"),
    ("stop", "latches at the robot, needs a deliberate reset", "–", "–", "stops all components", "–"),
    ("recording", "telemetry, commands, hash-chained audit", "rosbag", "storages", "data capture", "MCAP"),
)
_NOTE: Final = """Taken from the published documentation of the compared protocols, and of Viam, which uses gRPC; not
measured here. – means that the application must provide it. Only the Telescope values above include these functions."""


def table() -> Table:
    """Returns the table for the results page."""
    return Table(title="Safety functions", columns=COLUMNS, rows=[list(row) for row in _ROWS], note=_NOTE)

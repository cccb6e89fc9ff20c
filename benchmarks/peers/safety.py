"""What stands behind the figures: what each side does for the safety of people and motors, and what it leaves."""

from typing import Final

from benchmarks.reporting.report import Table

COLUMNS: Final = ["", "Telescope", "rosbridge", "zenoh", "gRPC (Viam)", "Foxglove"]
_ROWS: Final = (
    (
        "who may publish",
        "short-lived credentials for the topics of one device",
        "all, or a list of topics",
        "access control lists",
        "API keys, roles",
        "whoever connects",
    ),
    ("one controller", "a lease whose number the robot itself checks", "–", "–", "–", "–"),
    ("nobody sends any more", "holds after 300 ms", "–", "–", "after 2 s", "–"),
    ("late setpoints", "loop age over 200 ms: dropped", "–", "–", "–", "–"),
    ("limits", "position, speed, acceleration, space, own body", "–", "–", "–", "–"),
    ("stop", "latches at the robot, reset on purpose", "–", "–", "of all parts", "–"),
    ("record", "sessions, commands, hash-chained audit", "rosbag", "storages", "data capture", "MCAP"),
)
_NOTE: Final = """Of the wires that are compared, and of Viam as what is built on gRPC; by what is published of them,
not measured here. – is left to whoever builds on it. Of the figures above, only Telescope's contain any of this."""


def table() -> Table:
    """Returns the row for the results page."""
    return Table(title="And what is in it", columns=COLUMNS, rows=[list(row) for row in _ROWS], note=_NOTE)

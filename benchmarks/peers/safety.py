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
        "every connected client",
    ),
    ("one controller", "a lease whose number the robot itself checks", "–", "–", "–", "–"),
    ("commands stop", "holds after 300 ms", "–", "–", "after 2 s", "–"),
    ("late setpoints", "loop age over 200 ms: dropped", "–", "–", "–", "–"),
    ("limits", "position, speed, acceleration, space, own body", "–", "–", "–", "–"),
    ("stop", "latches at the robot, reset on purpose", "–", "–", "of all parts", "–"),
    ("record", "sessions, commands, hash-chained audit", "rosbag", "storages", "data capture", "MCAP"),
)
_NOTE: Final = """Taken from the published documentation of the compared protocols, and of Viam, which uses gRPC; not
measured here. – means that the application must provide it. Only the Telescope values above include these functions."""


def table() -> Table:
    """Returns the row for the results page."""
    return Table(title="And what is in it", columns=COLUMNS, rows=[list(row) for row in _ROWS], note=_NOTE)

"""Rerun's own reader returns what the recording contains."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.harness.agent.recordings.synthetic import FIRST_SEQUENCE, Session, write_session
from tests.harness.paths import RERUN, ROOT

SESSION = Session(
    periods=100, every=30, missing=range(40, 50), cameras={"/frames/front": range(0, 100, 10)}, events={20: "held"}
)


def run(*arguments: object) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(RERUN)))}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True, timeout=120).stdout


@pytest.mark.long
def test_values_images_and_events_equal_the_recording(tmp_path: Path) -> None:
    write_session(tmp_path / "recording", SESSION)
    output = tmp_path / "session.rrd"
    printed = run(
        "-m", "device_agent", "export", "--recording", tmp_path / "recording", "--format", "rerun", "--output", output
    )
    assert "exported 90 control rows and 10 images" in printed
    content = json.loads(run(Path(__file__).with_name("read_rerun.py"), output))
    rows = list(SESSION.rows())
    for joint, name in enumerate(("base", "elbow")):
        for quantity in ("position", "commanded", "applied"):
            values = [(at_ns, value) for at_ns, value in content[f"/joints/{name}/{quantity}"] if not math.isnan(value)]
            expected = [
                ((row.sequence - FIRST_SEQUENCE) * 20_000_000, getattr(row, f"{quantity}_rad")[joint]) for row in rows
            ]
            assert values == expected
    (interruption,) = [at_ns for at_ns, value in content["/joints/base/position"] if math.isnan(value)]
    assert interruption == 39 * 20_000_000 + 1
    assert [at_ns for at_ns, _ in content["/frames/front"]] == [number * 200_000_000 for number in range(10)]
    assert content["/events"] == [[400_000_000, "motion-held: held"]]

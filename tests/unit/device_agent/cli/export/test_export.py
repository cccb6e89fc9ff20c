"""``export`` writes CSV and MCAP files, checks its options, and leaves nothing unfinished behind."""

import csv
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader

from device_agent import __main__ as program
from device_agent.cli.export.recording import open_recording
from device_agent.cli.export.request import Progress
from device_agent.runtime.recording import format as recording_format
from tests.harness.agent.recordings.synthetic import FIRST_SEQUENCE, Session, write_session

FRONT = "/frames/front"
SESSION = Session(
    periods=100, every=30, missing=range(40, 50), cameras={FRONT: range(0, 100, 10)}, events={20: "held, once"}
)
Export = Callable[..., int]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write_session(tmp_path / "recording", SESSION)
    return tmp_path / "recording"


@pytest.fixture
def export(recording: Path, tmp_path: Path) -> Export:
    """Runs the command on the recording; returns its exit code."""

    def run(format_name: str, *options: object, output: str = "out") -> int:
        arguments = ["--recording", recording, "--format", format_name, "--output", tmp_path / output, *options]
        return program.main(["export", *map(str, arguments)])

    return run


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_csv_has_one_line_for_each_row_with_units_in_the_header(export: Export, tmp_path: Path) -> None:
    assert export("csv") == 0
    lines, rows = read(tmp_path / "out" / "control.csv"), list(SESSION.rows())
    assert [int(line["sequence"]) for line in lines] == [row.sequence for row in rows]
    for line, row in zip(lines, rows, strict=True):
        assert float(line["time [s]"]) == pytest.approx((row.sequence - FIRST_SEQUENCE) * 0.02)
        assert int(line["tick [ns]"]) == row.tick_ns
        for joint, name in enumerate(("base", "elbow")):
            assert float(line[f"{name}.position [rad or m]"]) == row.position_rad[joint]
            assert float(line[f"{name}.applied [rad or m]"]) == row.applied_rad[joint]
            assert float(line[f"{name}.commanded [rad or m]"]) == row.commanded_rad[joint]
            assert line[f"{name}.effort [Nm or N]"] == ""
        assert (line["mode"], line["source"], line["limited"]) == ("streaming", "operator", "velocity workspace")
        assert float(line["twist.turn [rad/s]"]) == row.twist[2]
    assert [line["time [s]"] for line in lines if line["after_gap"] == "1"] == ["1.000000"]


def test_csv_has_measurements_and_events(export: Export, tmp_path: Path) -> None:
    assert export("csv") == 0
    measured = read(tmp_path / "out" / "measurements.csv")
    assert [float(line["value"]) for line in measured] == [30.0 + period for period in range(0, 100, 10)]
    assert {line["name and unit"] for line in measured} == {"temperature_c.elbow"}
    (event,) = read(tmp_path / "out" / "events.csv")
    assert (event["time [s]"], event["kind"], event["message"]) == ("0.400000", "motion-held", "held, once")


def test_mcap_is_one_indexed_file_with_all_messages(export: Export, recording: Path, tmp_path: Path) -> None:
    assert export("mcap", output="out.mcap") == 0
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        messages = [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
    assert summary is not None
    assert summary.chunk_indexes
    assert {schema.name for schema in summary.schemas.values()} == {"telescope.Message", "foxglove.CompressedImage"}
    expected = [(entry.topic, entry.time_ns, entry.data) for entry in open_recording([recording]).entries()]
    assert messages == expected
    assert len(messages) == 90 + 10 + 10 + 1


def test_an_exported_mcap_file_is_a_recording_again(export: Export, recording: Path, tmp_path: Path) -> None:
    assert export("mcap", output="out.mcap") == 0
    again = open_recording([tmp_path / "out.mcap"])
    assert list(again.rows()) == list(open_recording([recording]).rows())
    assert again.cameras == (FRONT,)


def test_an_episode_contains_only_its_time(export: Export, tmp_path: Path) -> None:
    episodes = [
        {"start_s": 1.2, "end_s": 1.5, "outcome": None, "label": "second", "note": None, "later_field": 1},
        {"start_s": 0.1, "end_s": 0.2, "outcome": "success", "label": "first", "note": None},
    ]
    (tmp_path / "episodes.json").write_text(json.dumps(episodes), encoding="utf-8")
    assert export("mcap", "--episodes", tmp_path / "episodes.json", "--episode", 1, output="out.mcap") == 0
    exported = open_recording([tmp_path / "out.mcap"])
    assert [row.control.sequence - FIRST_SEQUENCE for row in exported.rows()] == list(range(60, 76))
    with (tmp_path / "out.mcap").open("rb") as file:
        stored = {one.name: one.metadata for one in make_reader(file).iter_metadata()}
    assert [one["label"] for one in json.loads(stored["telescope-episodes"]["episodes"])] == ["second"]


def test_messages_of_overlapping_episodes_are_written_once(export: Export, tmp_path: Path) -> None:
    episodes = [{"start_s": 0.1, "end_s": 0.3}, {"start_s": 0.2, "end_s": 0.4}]
    (tmp_path / "episodes.json").write_text(json.dumps(episodes), encoding="utf-8")
    assert export("mcap", "--episodes", tmp_path / "episodes.json", output="out.mcap") == 0
    rows = open_recording([tmp_path / "out.mcap"]).rows()
    assert [row.control.sequence - FIRST_SEQUENCE for row in rows] == list(range(5, 21))


def test_an_existing_output_is_not_overwritten(
    export: Export, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").write_text("mine", encoding="utf-8")
    assert export("csv") == 1
    assert "out exists; name a new path" in capsys.readouterr().err
    assert (tmp_path / "out").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize("format_name", ["csv", "lerobot", "mcap"])
def test_a_failed_export_leaves_nothing_behind(
    export: Export, recording: Path, tmp_path: Path, format_name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    last = recording / "000003.mcap"
    last.write_bytes(last.read_bytes()[:-30])
    assert export(format_name) == 1
    assert "000003.mcap is truncated or damaged; add --readable" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["recording"]
    assert export(format_name, "--readable") == 0
    assert "000003.mcap is truncated or damaged; the messages after" in capsys.readouterr().err


def test_a_lerobot_export_without_a_frame_is_an_error(
    export: Export, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "episodes.json").write_text('[{"start_s": 30, "end_s": 31}]', encoding="utf-8")
    assert export("lerobot", "--episodes", tmp_path / "episodes.json") == 1
    assert "no frame has a row and an image of each camera" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--fps", "0"], "--fps: 0 is not between 1 and 200"),
        (["--camera", "back"], "--camera: no camera 'back'; the recording has: front"),
        (["--episode", "0"], "--episode: the session has no episode 0; it has none"),
        (["--server", "http://127.0.0.1:1"], "--recording cannot be combined with --server"),
        (["--episodes", "missing.json"], "missing.json cannot be read: No such file or directory"),
    ],
)
def test_a_wrong_option_is_named(
    export: Export, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export("csv", *options) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "is not a list of episodes with start_s and end_s"),
        ('[{"start_s": 2, "end_s": 1}]', "an episode from 2 s to 1 s is not possible"),
    ],
)
def test_wrong_episodes_are_named(
    export: Export, tmp_path: Path, content: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "episodes.json").write_text(content, encoding="utf-8")
    assert export("csv", "--episodes", tmp_path / "episodes.json") == 1
    assert message in capsys.readouterr().err


def test_missing_options_of_the_server_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["export", "--server", "http://127.0.0.1:1", "--format", "csv", "--output", str(tmp_path / "out")]
    assert program.main(arguments) == 1
    assert "--device, --session, --api-key-file is missing" in capsys.readouterr().err


def test_a_message_of_a_later_version_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Later(Session):
        def row(self, period: int) -> Any:
            return {"tick_ns": period}

    write_session(tmp_path / "recording", Later(periods=10))
    monkeypatch.chdir(tmp_path)
    assert program.main(["export", "--recording", "recording", "--format", "csv", "--output", "out"]) == 1
    assert "a message of /control cannot be read: " in capsys.readouterr().err


def test_a_missing_library_is_an_error_with_the_command_that_installs_it(
    export: Export, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith("device_agent.cli.export.lerobot")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert export("lerobot") == 1
    assert "run `pip install 'telescope-agent[export]'`" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert export("rerun") == 1
    assert "run `pip install 'telescope-agent[rerun]'`" in capsys.readouterr().err


def test_help_names_formats_and_sources(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        program.main(["export", "--help"])
    text = capsys.readouterr().out
    assert "{csv,lerobot,mcap,rerun}" in text
    assert "--api-key-file" in text


def test_progress_prints_at_most_once_a_second(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = 0.0
    progress = Progress(sys.stdout, lambda: now_s)
    for item in progress.count(range(30), "rows"):
        now_s = (item + 1) / 10
    assert capsys.readouterr().out == "10 rows\n20 rows\n30 rows\n"


def test_the_fixture_follows_the_format(recording: Path) -> None:
    with (recording / "000000.mcap").open("rb") as file:
        (metadata,) = make_reader(file).iter_metadata()
    fields = {name: json.loads(value) for name, value in metadata.metadata.items()}
    assert msgspec.convert(fields, recording_format.SegmentInfo) == SESSION.info(0)

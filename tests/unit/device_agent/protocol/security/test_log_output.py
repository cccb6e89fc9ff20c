"""Log lines: text and JSON, their context, rotation, and the limit for repeated lines."""

import argparse
import json
import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.protocol.security import log_output
from device_agent.protocol.security.log_output import (
    BURST,
    MAX_TRACEBACK,
    JsonFormatter,
    RateLimit,
    RecentErrors,
    TextFormatter,
)


def record(message: str, *arguments: object, level: int = logging.WARNING, name: str = "test") -> logging.LogRecord:
    return logging.LogRecord(name, level, __file__, 1, message, arguments, None)


def fail() -> None:
    raise ValueError("x" * 2 * MAX_TRACEBACK)


def failing() -> logging.LogRecord:
    try:
        fail()
    except ValueError:
        return logging.LogRecord("test", logging.ERROR, __file__, 1, "it failed", (), sys.exc_info())
    raise AssertionError


@pytest.fixture
def context() -> Iterator[None]:
    token = log_output.context.set(lambda: {"request": "r1", "device": "a-arm", "action": ""})
    yield
    log_output.context.reset(token)


@pytest.mark.usefixtures("context")
def test_a_text_line_ends_with_its_context() -> None:
    assert TextFormatter().format(record("%s is slow", "it")).endswith("WARNING it is slow [request=r1 device=a-arm]")


def test_a_line_without_context_has_no_brackets() -> None:
    assert TextFormatter().format(record("plain")).endswith("WARNING plain")


@pytest.mark.usefixtures("context")
def test_a_json_line_is_one_object_with_its_context() -> None:
    text = JsonFormatter().format(record("two\nlines"))
    line = json.loads(text)
    assert "\n" not in text
    assert line.pop("time").endswith("+00:00")
    assert line == {"level": "warning", "logger": "test", "message": "two\nlines", "request": "r1", "device": "a-arm"}


def test_an_exception_is_part_of_its_line_and_bounded() -> None:
    line = json.loads(JsonFormatter().format(failing()))
    assert "xxx" in line["exception"]
    assert len(line["exception"]) == MAX_TRACEBACK
    assert len(TextFormatter().format(failing())) < MAX_TRACEBACK + 200


def test_a_context_that_cannot_be_read_does_not_prevent_the_line() -> None:
    token = log_output.context.set(lambda: dict[str, dict[str, str]]()["missing"])
    try:
        assert "plain" in TextFormatter().format(record("plain"))
    finally:
        log_output.context.reset(token)


class TestRateLimit:
    def test_lines_with_the_same_text_are_limited_whatever_their_values(self) -> None:
        now_s = [0.0]
        limit = RateLimit(lambda: now_s[0])
        assert sum(limit.filter(record("attempt %d", number)) for number in range(10_000)) == BURST
        now_s[0] = 10.0
        last = record("attempt %d", 10_000)
        assert limit.filter(last)
        assert last.getMessage() == f"attempt 10000 ({10_000 - BURST} similar lines omitted)"
        assert not limit.filter(record("attempt %d", 1))

    def test_other_texts_levels_and_loggers_pass(self) -> None:
        limit = RateLimit(lambda: 0.0)
        for _ in range(BURST + 1):
            limit.filter(record("attempt"))
        assert not limit.filter(record("attempt"))
        assert limit.filter(record("other"))
        assert limit.filter(record("attempt", level=logging.ERROR))
        assert limit.filter(record("attempt", name="other"))

    def test_many_different_texts_are_limited_together_and_forgotten(self) -> None:
        now_s = [0.0]
        limit = RateLimit(lambda: now_s[0])
        assert sum(limit.filter(record(f"text {number}")) for number in range(5_000)) == 400
        now_s[0] = 1.0
        assert sum(limit.filter(record(f"later {number}")) for number in range(5_000)) == 20
        assert len(limit._keys) == 1_000


def test_recent_errors_keep_the_newest_of_each_text() -> None:
    recent = RecentErrors()
    for message in [*(f"error {number}" for number in range(30)), "error 25"]:
        recent.handle(record(message))
    lines = [line[1:] for line in recent.lines()]
    assert len(lines) == 20
    assert lines[:2] == [("warning", "error 25"), ("warning", "error 29")]


def options(*arguments: str, **environment: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    log_output.add_arguments(parser, environment)
    return parser.parse_args(arguments)


def test_a_file_is_rotated_by_size_and_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_output, "FILE_BYTES", 2_000)
    monkeypatch.setattr(log_output, "FILE_COUNT", 2)
    handler = log_output.create_handler(options("--log-file", str(tmp_path / "worker.log"), "--log-format", "json"))
    for number in range(100):
        handler.handle(record(f"text {number}"))  # different texts, which the limit passes
    handler.close()
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["worker.log", "worker.log.1", "worker.log.2"]
    assert all(file.stat().st_size <= 2_000 for file in files)
    assert json.loads((tmp_path / "worker.log").read_text().splitlines()[-1])["message"] == "text 99"


def test_the_environment_selects_the_format() -> None:
    assert options().log_format == "text"
    assert options(TELESCOPE_LOG_FORMAT="json").log_format == "json"
    assert options(TELESCOPE_LOG_FORMAT="other").log_format == "text"


def test_without_a_file_lines_go_to_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    handler = log_output.create_handler(options())
    for _ in range(BURST + 1):
        handler.handle(record("plain"))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == BURST
    assert lines[0].endswith("WARNING plain")

"""Publication of simulated trials: the numbers that a server receives, and errors that say what to do."""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from device_agent.cli.trials import _publisher, add_commands
from device_agent.cli.trials.publish import Publisher, Version, cause_of
from device_agent.config.errors import ConfigError
from device_agent.config.release import VERSION
from device_agent.protocol import TrialCause
from tests.harness.network.http_server import QuietHandler, serve

WHAT = Version(tasks_sha256="1" * 64, movement_sha256="2" * 64, type_version=3)


@dataclass(frozen=True)
class Result:
    success: bool = False
    lifted: bool = False
    timed_out: bool = False
    script_error: str = ""


def parsed(*arguments: str) -> argparse.Namespace:
    """The options of the command ``trials``."""
    parser = argparse.ArgumentParser()
    add_commands(parser.add_subparsers(), Path())
    return parser.parse_args(["trials", *arguments])


class Server:
    """A server whose response a test chooses."""

    def __init__(self) -> None:
        self.status, self.body = 201, b"{}"
        self.received: list[tuple[str, str, Any]] = []
        self.url = ""


@pytest.fixture
def server() -> Iterator[Server]:
    chosen = Server()

    class Handler(QuietHandler):
        def handle_any(self) -> None:
            content = self.rfile.read(int(self.headers["Content-Length"]))
            chosen.received.append((self.path, self.headers["Authorization"], json.loads(content)))
            self.respond(chosen.status, [], chosen.body)

    with serve(Handler) as url:
        chosen.url = url
        yield chosen


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "key"
    path.write_text("ts_secret\n", encoding="ascii")
    return path


@pytest.mark.parametrize(
    ("result", "cause"),
    [
        (Result(success=True, script_error="late"), TrialCause.NONE),
        (Result(timed_out=True, script_error="the time limit has passed", lifted=True), TrialCause.TIME_LIMIT),
        (Result(script_error="line 3: no cube", lifted=True), TrialCause.MOVEMENT_FAILED),
        (Result(lifted=True), TrialCause.INCOMPLETE),
        (Result(), TrialCause.NOT_MET),
    ],
)
def test_the_cause_is_the_one_that_an_agent_reports(result: Result, cause: TrialCause) -> None:
    assert cause_of(result) is cause


def test_results_are_published_with_their_versions(server: Server, key: Path) -> None:
    results = [Result(success=True), Result(), Result(lifted=True), Result()]
    Publisher(server.url + "/", key, None).publish("arm/a task", WHAT, 7, results)
    ((path, authorization, body),) = server.received
    assert (path, authorization) == ("/api/v1/robot-types/arm/tasks/a%20task/batches", "Bearer ts_secret")
    assert body == {
        "tasks_sha256": "1" * 64,
        "movement_sha256": "2" * 64,
        "type_version": 3,
        "first_seed": 7,
        "trials": 4,
        "successes": 1,
        "causes": {"not_met": 2, "incomplete": 1},
        "software": VERSION,
    }


@pytest.mark.parametrize(
    ("status", "body", "reason"),
    [(403, b'{"detail": "This API key may only read."}', "may only read"), (500, b"<html>", "Internal Server Error")],
)
def test_a_rejection_is_an_error_with_its_reason(
    server: Server, key: Path, status: int, body: bytes, reason: str
) -> None:
    server.status, server.body = status, body
    with pytest.raises(ConfigError, match=f"the server rejects the results: .*{reason}"):
        Publisher(server.url, key, None).publish("arm/task", WHAT, 0, [Result()])


def test_a_server_that_does_not_respond_is_an_error(key: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be reached; check --publish"):
        Publisher("http://127.0.0.1:9", key, None).publish("arm/task", WHAT, 0, [Result()])


def test_addresses_and_keys_are_checked_before_the_trials(tmp_path: Path, key: Path) -> None:
    with pytest.raises(ConfigError, match="is not an address like https://host"):
        Publisher("host", key, None)
    with pytest.raises(ConfigError, match="an http server has no certificate"):
        Publisher("http://host", key, key)
    with pytest.raises(ConfigError, match="cannot be read; store an API key in it"):
        Publisher("http://host", tmp_path / "missing", None)
    (tmp_path / "empty").write_text("\n", encoding="ascii")
    with pytest.raises(ConfigError, match="is empty; store an API key in it"):
        Publisher("https://host", tmp_path / "empty", None)


def test_a_publication_needs_a_key(key: Path) -> None:
    assert _publisher(parsed("--task", "arm/task")) is None
    with pytest.raises(ConfigError, match="--publish needs --api-key-file"):
        _publisher(parsed("--task", "arm/task", "--publish", "http://host"))
    assert _publisher(parsed("--task", "arm/task", "--publish", "http://host", "--api-key-file", str(key))) is not None

"""The process of a script action: kills, failed starts, invalid messages and floods."""

import contextlib
import json
import socket
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from device_agent.ports import script_calls
from device_agent.runtime.actions import script_action
from device_agent.runtime.actions.script_action import ScriptFailed
from device_agent.runtime.errors import Refused
from tests.harness.agent.device_harness import eventually
from tests.unit.device_agent.runtime.actions.script_action_fixture import FakeProcess, FakeSandbox, Run, run_fake


def test_kill_ends_a_script_that_ignores_signals() -> None:
    source = "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('here')\nwhile True: pass"
    started, failures = Run(source), list[str]()

    def body() -> None:
        try:
            started.script.run()
        except ScriptFailed as failed:
            failures.append(str(failed))

    thread = threading.Thread(target=body)
    thread.start()
    eventually(lambda: started.output.printed)
    started.script.kill()
    started.script.kill()
    thread.join(10)
    assert failures == ["the script's process ended before the script did"]


def test_the_end_of_a_process_in_a_call_releases_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()
    started = Run("robot.home()", on_exit=released.set)

    def execute(_: script_calls.Call) -> Any:
        process = started.script._process
        assert process is not None
        process.kill()
        assert released.wait(10), "the call was not interrupted"
        raise Refused("ended", "the action ended")

    monkeypatch.setattr(started.api, "execute", execute)
    with pytest.raises(ScriptFailed, match="ended before the script did"):
        started.script.run()


def test_a_process_that_does_not_exit_does_not_block_the_action() -> None:
    process, exited = FakeProcess(exits=False), threading.Event()
    process.send(b'{"kind":"ready"}', b'{"kind":"ended"}')
    Run(sandbox=FakeSandbox(process), on_exit=exited.set).script.run()
    assert not exited.is_set()


def test_a_script_killed_before_its_start_does_not_run() -> None:
    started = Run("robot.home()")
    started.script.kill()
    with pytest.raises(ScriptFailed):
        started.script.run()
    assert started.api.received == []


def test_a_failed_process_start_is_reported() -> None:
    with pytest.raises(ScriptFailed, match="no process can be started"):
        run_fake(None)


@pytest.mark.parametrize(
    ("first", "expected"),
    [
        (b'{"kind": "unfit", "reason": "landlock: no"}', "the sandbox is incomplete: landlock: no"),
        *((line, "ended before the script did: it crashed") for line in (b'{"kind": "nonsense"}', b"", b"\xff\xfe")),
    ],
)
def test_a_process_without_a_valid_first_message_gets_no_script(first: bytes, expected: str) -> None:
    process = FakeProcess()
    process.send(first)
    with pytest.raises(ScriptFailed, match=expected):
        run_fake(process)


def test_a_silent_process_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script_action, "_READY_TIMEOUT_S", 0.05)
    with pytest.raises(ScriptFailed, match="it stopped following the protocol"):
        run_fake(FakeProcess(exits=False))


def test_an_endless_line_ends_the_script() -> None:
    process = FakeProcess()
    process.send(b'{"kind": "ready"}')

    def flood() -> None:
        with contextlib.suppress(OSError):
            process.script_end.sendall(b" " * (4 * script_calls.MAX_LINE))

    thread = threading.Thread(target=flood)
    thread.start()
    with pytest.raises(ScriptFailed, match="ended before"):
        run_fake(process)
    thread.join(10)


def test_a_line_that_is_too_long_ends_the_script() -> None:
    with socket.socket() as unread:
        lines = script_action._LineReader(unread, threading.Event())
        lines._buffer = b" " * script_calls.MAX_LINE + b"\n"
        with pytest.raises(EOFError):
            lines.read()


def test_repeated_and_invalid_messages_are_answered_with_errors() -> None:
    process = FakeProcess()
    process.send(
        b'{"kind": "ready"}',
        b'{"kind": "ready"}',
        b'{"kind": "progress", "share": 7}',
        b'{"kind": "output", "text": "x"}',
        b'{"kind": "ended", "error": ""}',
    )
    answers = process.script_end.dup()
    output = run_fake(process)
    assert (output.printed, output.progress) == ("x", [])
    script, repeated, invalid = (json.loads(line) for line in answers.makefile("rb").read().splitlines())
    assert script["name"] == "wave"
    assert repeated == {"error": "this message may be sent only once"}
    assert "share" in invalid["error"]
    answers.close()


def test_a_flooding_script_is_throttled(monkeypatch: pytest.MonkeyPatch) -> None:
    agent_end, script_end = socket.socketpair()
    with agent_end, script_end:
        killed = threading.Event()
        waited: list[float] = []
        monkeypatch.setattr(killed, "wait", waited.append)
        monkeypatch.setattr(script_action, "time", SimpleNamespace(monotonic=lambda: 0.0))  # a slow reader has credit
        lines = script_action._LineReader(agent_end, killed)
        script_end.sendall(b"{}\n" * 700)
        for _ in range(700):
            assert lines.read() == b"{}"
    assert len(waited) > 100
    assert 0 < max(waited) < 10

"""The process of a script action: kills, failed starts, invalid messages and floods."""

import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from device_agent.ports import script_calls
from device_agent.runtime.actions import script_action
from device_agent.runtime.actions.script_action import ScriptAction, ScriptFailed, ScriptSandbox
from device_agent.runtime.errors import Refused
from tests.harness.agent.sandbox import warm_sandbox
from tests.unit.device_agent.runtime.actions.script_action_fixture import (
    FakeProcess,
    FakeSandbox,
    RecordedOutput,
    RecordingApi,
    ignore_exit,
    run_fake,
    run_movement,
)


@contextlib.contextmanager
def running(script: ScriptAction) -> Iterator[list[ScriptFailed]]:
    failures: list[ScriptFailed] = []

    def body() -> None:
        try:
            script.run()
        except ScriptFailed as failed:
            failures.append(failed)

    thread = threading.Thread(target=body)
    thread.start()
    yield failures
    thread.join(10)
    assert not thread.is_alive()


def test_a_script_is_killed_at_once() -> None:
    output = RecordedOutput()
    source = "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('here')\nwhile True: pass"
    script = ScriptAction(
        run_movement(source),
        RecordingApi(),
        output,
        sandbox=ScriptSandbox(warm_sandbox(), untrusted=False),
        on_exit=ignore_exit,
    )
    with running(script) as failures:
        while not output.printed:
            time.sleep(0.01)
        script.kill()
        script.kill()
    assert [str(failure) for failure in failures] == ["the script's process ended before the script did"]


def test_a_script_that_dies_in_a_call_releases_the_robot_at_once() -> None:
    released = threading.Event()

    class Busy(RecordingApi):
        def execute(self, call: script_calls.Call) -> Any:
            del call
            process = script._process
            assert process is not None
            process.kill()
            assert released.wait(10), "the call was not interrupted"
            raise Refused("ended", "the action ended")

    script = ScriptAction(
        run_movement("robot.home()"),
        Busy(),
        RecordedOutput(),
        sandbox=ScriptSandbox(warm_sandbox(), untrusted=False),
        on_exit=released.set,
    )
    with pytest.raises(ScriptFailed, match="ended before the script did"):
        script.run()


def test_a_process_that_survives_kill_does_not_block_the_action() -> None:
    process = FakeProcess(exits=False)
    process.send(b'{"kind":"ready"}', b'{"kind":"ended"}')
    exited = threading.Event()
    ScriptAction(
        run_movement(""),
        RecordingApi(),
        RecordedOutput(),
        sandbox=ScriptSandbox(FakeSandbox(process), untrusted=False),
        on_exit=exited.set,
    ).run()
    assert not exited.is_set()


def test_a_script_killed_before_its_start_does_not_run() -> None:
    api = RecordingApi()
    script = ScriptAction(
        run_movement("robot.home()"),
        api,
        RecordedOutput(),
        sandbox=ScriptSandbox(warm_sandbox(), untrusted=False),
        on_exit=ignore_exit,
    )
    script.kill()
    with pytest.raises(ScriptFailed):
        script.run()
    assert api.received == []


def test_a_failed_process_start_is_reported() -> None:
    script = ScriptAction(
        run_movement(""),
        RecordingApi(),
        RecordedOutput(),
        sandbox=ScriptSandbox(FakeSandbox(None), untrusted=False),
        on_exit=ignore_exit,
    )
    with pytest.raises(ScriptFailed, match="no process can be started"):
        script.run()


def test_a_broken_sandbox_receives_no_script() -> None:
    process = FakeProcess()
    process.send(b'{"kind": "unfit", "reason": "landlock: no"}')
    with pytest.raises(ScriptFailed, match="the sandbox is incomplete: landlock: no"):
        run_fake(process)


@pytest.mark.parametrize("first", [b'{"kind": "nonsense"}', b"", b"\xff\xfe"])
def test_a_process_with_an_invalid_first_message_gets_no_script(first: bytes) -> None:
    process = FakeProcess()
    process.send(first)
    with pytest.raises(ScriptFailed, match="ended before the script did: it crashed"):
        run_fake(process)


def test_a_silent_process_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script_action, "_READY_TIMEOUT_S", 0.05)
    with pytest.raises(ScriptFailed, match="it stopped following the protocol"):
        run_fake(FakeProcess(exits=False))


def test_an_endless_line_ends_the_script() -> None:
    process = FakeProcess()
    process.send(b'{"kind": "ready"}')
    flood = threading.Thread(target=_flood, args=(process.theirs,))
    flood.start()
    with pytest.raises(ScriptFailed, match="ended before"):
        run_fake(process)
    flood.join(10)


def _flood(link: socket.socket) -> None:
    with contextlib.suppress(OSError):
        link.sendall(b" " * (4 * script_calls.MAX_LINE))


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
    answers = process.theirs.dup()
    output = run_fake(process)
    assert (output.printed, output.progress) == ("x", [])
    got = [json.loads(line) for line in answers.makefile("rb").read().splitlines()]
    assert got[0]["name"] == "wave"
    assert got[1] == {"error": "this message may be sent only once"}
    assert "share" in got[2]["error"]
    answers.close()


def test_a_flooding_script_is_throttled(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        killed = threading.Event()
        waited: list[float] = []
        monkeypatch.setattr(killed, "wait", waited.append)
        lines = script_action._LineReader(ours, killed)
        theirs.sendall(b"{}\n" * 700)
        for _ in range(700):
            assert lines.read() == b"{}"
    assert len(waited) > 100
    assert 0 < max(waited) < 10

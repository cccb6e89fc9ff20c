"""Script actions: calls, errors, kills and limits of the sandboxed process."""

import contextlib
import hashlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from device_agent import protocol
from device_agent.ports import script_calls
from device_agent.ports.sandbox import Limits, SandboxError, SandboxStatus
from device_agent.protocol import RunMovement
from device_agent.runtime.actions import script_action
from device_agent.runtime.actions.script_action import ScriptAction, ScriptFailed, ScriptSandbox
from device_agent.runtime.errors import Refused
from tests.harness.agent.sandbox import warm_sandbox


class Notes:
    joints = ("shoulder", "elbow")
    frames = ("tool",)
    calls = ("move_joints", "home", "state")

    def __init__(self) -> None:
        self.received: list[Any] = []

    def execute(self, call: script_calls.Call) -> Any:
        match call:
            case protocol.MoveJoints(position_rad=position_rad, speed=speed):
                if "knee" in position_rad:
                    raise Refused("unknown_joint", "no joint 'knee'")
                self.received.append((position_rad, speed))
            case script_calls.AskState():
                return {"position_rad": {"shoulder": 0.1, "elbow": 0.2}, "mode": "action"}
            case _:
                self.received.append(call)
        return None


def nothing() -> None:
    """Ignore the exit of the process."""


class Told:
    def __init__(self) -> None:
        self.printed = ""
        self.progress: list[float] = []

    def __call__(self, text: str, share: float | None) -> None:
        self.printed += text
        if share is not None:
            self.progress.append(share)


class FakeProcess:
    """A process with preset messages."""

    def __init__(self, *, dies: bool = True) -> None:
        self.link, self.theirs = socket.socketpair()
        self.dies = dies
        self.killed = False

    def say(self, *lines: bytes) -> None:
        self.theirs.sendall(b"".join(line + b"\n" for line in lines))

    def kill(self) -> None:
        self.killed = True

    def wait(self, timeout_s: float) -> bool:
        del timeout_s
        return self.dies

    def ending(self) -> str:
        return "it crashed"

    def close(self) -> None:
        self.link.close()
        self.theirs.close()


class FakeSandbox:
    def __init__(self, process: FakeProcess | None) -> None:
        self.process = process

    def start(self) -> None:
        pass

    def status(self) -> SandboxStatus:
        return SandboxStatus("sandboxed")

    def refusal(self, *, untrusted: bool) -> str | None:
        del untrusted
        return None

    def open(self, limits: Limits, *, untrusted: bool) -> FakeProcess:
        del limits, untrusted
        if self.process is None:
            raise SandboxError("no process can be started for the script")
        return self.process

    def close(self) -> None:
        pass


def order(source: str, parameters: dict[str, Any] | None = None) -> RunMovement:
    digest = hashlib.sha256(source.encode()).hexdigest()
    return RunMovement(
        robot_type="toy", name="wave", version=1, sha256=digest, source=source, parameters=parameters or {}
    )


def run(source: str, parameters: dict[str, Any] | None = None) -> tuple[Notes, Told]:
    notes, told = Notes(), Told()
    ScriptAction(
        order(source, parameters), notes, told, sandbox=ScriptSandbox(warm_sandbox(), untrusted=False), on_exit=nothing
    ).run()
    return notes, told


def run_fake(process: FakeProcess) -> Told:
    told = Told()
    ScriptAction(
        order(""), Notes(), told, sandbox=ScriptSandbox(FakeSandbox(process), untrusted=False), on_exit=nothing
    ).run()
    return told


def test_a_script_moves_prints_and_reads_its_parameters() -> None:
    notes, told = run(
        "for angle in parameters['angles']:\n"
        "    robot.move_joints({'elbow': angle}, speed=0.3)\n"
        "robot.move_joints([1, 2])\n"
        "robot.home()\n"
        "wait(0.01)\n"
        "progress(0.5)\n"
        "print('elbow', robot.state()['position_rad']['elbow'], robot.joints, robot.frames, robot.can[0])\n",
        {"angles": [0.5, 1]},
    )
    assert notes.received == [
        ({"elbow": 0.5}, 0.3),
        ({"elbow": 1.0}, 0.3),
        ({"shoulder": 1.0, "elbow": 2.0}, 0.5),
        script_calls.Home(speed=0.5),
    ]
    assert told.printed == "elbow 0.2 ('shoulder', 'elbow') ('tool',) move_joints\n"
    assert told.progress == [0.5]


def test_every_call_of_the_api_is_received_unchanged() -> None:
    notes, _ = run(
        "robot.move_to([0.1, 0, 0.3], rpy_rad=(0, 0, 1), speed=0.2)\n"
        "robot.move_to((0.1, 0, 0.3), quaternion=(1, 0, 0, 0), frame='camera')\n"
        "robot.drive(0.1, turn_rad_s=0.5, duration_s=2)\n"
        "robot.look((1, 0, 0))\n"
        "robot.say('ahoj', language='sk')\n"
        "robot.stiffness(0.5, ['elbow'])\n"
        "robot.express('smile', 0.7)\n"
        "robot.behaviour('wave')\n"
        "room.latest('agent-pir', 'presence')\n"
    )
    assert notes.received == [
        protocol.MovePose(frame="tool", position_m=(0.1, 0, 0.3), rpy_rad=(0, 0, 1), speed=0.2),
        protocol.MovePose(frame="camera", position_m=(0.1, 0, 0.3), quaternion=(1, 0, 0, 0), speed=0.5),
        protocol.Drive(forward_m_s=0.1, left_m_s=0, turn_rad_s=0.5, duration_s=2),
        protocol.LookAt(position_m=(1, 0, 0), speed=0.5),
        protocol.Say(text="ahoj", language="sk"),
        protocol.SetStiffness(value=0.5, joints=("elbow",)),
        protocol.Express(name="smile", strength=0.7),
        protocol.RunBehaviour(name="wave"),
        script_calls.AskLatest(device="agent-pir", stream="presence"),
    ]


def test_play_is_split_at_keyframes_with_other_calls() -> None:
    notes, _ = run(
        "robot.play([\n"
        "    {'time_s': 1, 'position_rad': {'elbow': 0.1}, 'say': 'off'},\n"
        "    {'time_s': 2, 'position_rad': {'elbow': 0.2}},\n"
        "    {'time_s': 3, 'express': 'smile', 'posture': 'Sit', 'drive': {'forward_m_s': 0.1, 'duration_s': 2}},\n"
        "    {'time_s': 5},\n"
        "    {'time_s': 5.5, 'position_rad': {'shoulder': 0.3}, 'go_to': {'x_m': 1, 'y_m': 2}, 'behaviour': 'nod'},\n"
        "], speed=0.5)\n"
        "robot.play([{'time_s': 0, 'say': 'end'}])\n"
        "robot.play([])\n"
    )
    there = script_calls.Moment(time_s=1, position_rad={"elbow": 0.2})
    assert notes.received == [
        ({"elbow": 0.1}, 0.25),
        protocol.Say(text="off", language=""),
        script_calls.Play(keyframes=(there, script_calls.Moment(time_s=2)), first=2, speed=0.5),
        protocol.TakePosture(name="Sit", speed=0.5),
        protocol.Express(name="smile", strength=1),
        protocol.Drive(forward_m_s=0.1, left_m_s=0, turn_rad_s=0, duration_s=2),
        script_calls.Play(
            keyframes=(script_calls.Moment(time_s=2), script_calls.Moment(time_s=2.5, position_rad={"shoulder": 0.3})),
            first=4,
            speed=0.5,
        ),
        protocol.RunBehaviour(name="nod"),
        protocol.GoTo(x_m=1, y_m=2),
        protocol.Say(text="end", language=""),
    ]


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("x = 1\ny = x / 0\n", "line 2: ZeroDivisionError"),
        ("def f():\n    raise ValueError('no')\n\n\nf()\n", "line 2: ValueError: no"),
        ("robot.move_joints({'elbow': float('nan')})", "line 1: ValueError"),
        ("robot.move_joints({'elbow': 10**400})", "line 1: OverflowError"),
        ("robot.move_joints([1])", "line 1: RobotError: 1 positions for 2 joints"),
        ("robot.move_joints({})", "line 1: RobotError: not a valid"),
        ("\nrobot.move_joints({'knee': 1})", "line 2: RobotError: no joint 'knee'"),
        ("robot.move_to([1, 2])", "line 1: RobotError: position_m needs 3 numbers, not 2"),
        ("robot.move_to([1, 2, 3], quaternion=[1, 0, 0, 0], rpy_rad=[0, 0, 0])", "line 1: RobotError: give a"),
        ("\n\nrobot.fly()", "line 3: AttributeError: there is no robot.fly; there are behaviour, drive"),
        ("if True print", "line 1: SyntaxError"),
        ("raise SystemExit(3)", "line 1: SystemExit: 3"),
        ("import asyncio", "line 1: ModuleNotFoundError: a script cannot import 'asyncio'; it can import abc"),
        ("x = bytearray(2**30)", "line 1: MemoryError"),
        ("import os\nos._exit(1)", "ended before the script did"),
        ("import os\nos._exit(7)", "ended before the script did: it ended with 7"),
        ("import ctypes\nctypes.string_at(0)", "ended before the script did: it crashed"),
        ("import ctypes\nctypes.CDLL(None).ptrace(0, 0, 0, 0)", "did: it made a forbidden system call"),
    ],
)
def test_a_failed_script_reports_the_line(source: str, says: str) -> None:
    with pytest.raises(ScriptFailed) as failed:
        run(source)
    assert says in str(failed.value)


def test_a_script_can_catch_rejections() -> None:
    _, told = run("try:\n    robot.move_joints({'knee': 1})\nexcept RobotError as e:\n    print(e)\n")
    assert told.printed == "no joint 'knee'\n"


@pytest.mark.parametrize(
    "source",
    [
        "import numpy as np; print(round(float(np.linalg.det(np.linalg.inv(np.diag([2.0, 4.0])))), 6))",
        "import datetime as d; print(d.datetime.strptime('2026', '%Y').year)",
        "import statistics, itertools, dataclasses, re, heapq, decimal; print(decimal.Decimal('0.1'))",
        "import random, secrets, uuid, hashlib; print(len(uuid.uuid4().hex))",
        "import time; print(time.localtime().tm_year > 2000, 'é'.encode('cp1252'))",
    ],
)
def test_common_imports_work_in_scripts(source: str) -> None:
    _, told = run(source)
    assert told.printed


def test_two_scripts_draw_different_random_numbers() -> None:
    source = "import random, numpy\nprint(random.random(), numpy.random.rand())"
    first, second = run(source)[1].printed, run(source)[1].printed
    assert len({*first.split(), *second.split()}) == 4


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
    told = Told()
    source = "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('here')\nwhile True: pass"
    script = ScriptAction(
        order(source), Notes(), told, sandbox=ScriptSandbox(warm_sandbox(), untrusted=False), on_exit=nothing
    )
    with running(script) as failures:
        while not told.printed:
            time.sleep(0.01)
        script.kill()
        script.kill()
    assert [str(failure) for failure in failures] == ["the script's process ended before the script did"]


def test_a_script_that_dies_in_a_call_releases_the_robot_at_once() -> None:
    let_go = threading.Event()

    class Busy(Notes):
        def execute(self, call: script_calls.Call) -> Any:
            del call
            process = script._process
            assert process is not None
            process.kill()
            assert let_go.wait(10), "the call went on for as long as it liked"
            raise Refused("ended", "the action ended")

    script = ScriptAction(
        order("robot.home()"),
        Busy(),
        Told(),
        sandbox=ScriptSandbox(warm_sandbox(), untrusted=False),
        on_exit=let_go.set,
    )
    with pytest.raises(ScriptFailed, match="ended before the script did"):
        script.run()


def test_a_process_that_survives_kill_does_not_block_the_action() -> None:
    process = FakeProcess(dies=False)
    process.say(b'{"kind":"ready"}', b'{"kind":"ended"}')
    died = threading.Event()
    ScriptAction(
        order(""), Notes(), Told(), sandbox=ScriptSandbox(FakeSandbox(process), untrusted=False), on_exit=died.set
    ).run()
    assert not died.is_set()


def test_a_script_killed_before_its_start_does_not_run() -> None:
    notes = Notes()
    script = ScriptAction(
        order("robot.home()"), notes, Told(), sandbox=ScriptSandbox(warm_sandbox(), untrusted=False), on_exit=nothing
    )
    script.kill()
    with pytest.raises(ScriptFailed):
        script.run()
    assert notes.received == []


def test_a_failed_process_start_is_reported() -> None:
    script = ScriptAction(
        order(""), Notes(), Told(), sandbox=ScriptSandbox(FakeSandbox(None), untrusted=False), on_exit=nothing
    )
    with pytest.raises(ScriptFailed, match="no process can be started"):
        script.run()


def test_a_broken_sandbox_receives_no_script() -> None:
    process = FakeProcess()
    process.say(b'{"kind": "unfit", "reason": "landlock: no"}')
    with pytest.raises(ScriptFailed, match="the sandbox is incomplete: landlock: no"):
        run_fake(process)


@pytest.mark.parametrize("first", [b'{"kind": "nonsense"}', b"", b"\xff\xfe"])
def test_a_process_with_an_invalid_first_message_gets_no_script(first: bytes) -> None:
    process = FakeProcess()
    process.say(first)
    with pytest.raises(ScriptFailed, match="ended before the script did: it crashed"):
        run_fake(process)


def test_a_silent_process_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script_action, "_READY_TIMEOUT_S", 0.05)
    with pytest.raises(ScriptFailed, match="it stopped following the protocol"):
        run_fake(FakeProcess(dies=False))


def test_an_endless_line_ends_the_script() -> None:
    process = FakeProcess()
    process.say(b'{"kind": "ready"}')
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
    process.say(
        b'{"kind": "ready"}',
        b'{"kind": "ready"}',
        b'{"kind": "progress", "share": 7}',
        b'{"kind": "output", "text": "x"}',
        b'{"kind": "ended", "error": ""}',
    )
    answers = process.theirs.dup()
    told = run_fake(process)
    assert (told.printed, told.progress) == ("x", [])
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

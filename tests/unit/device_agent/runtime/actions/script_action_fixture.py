"""A recording script API, a fake sandbox, and functions that run script actions on them."""

import hashlib
import socket
from collections.abc import Callable
from typing import Any

from device_agent import protocol
from device_agent.ports import script_calls
from device_agent.ports.sandbox import Limits, SandboxError
from device_agent.protocol import RunMovement
from device_agent.runtime.actions.script_action import ScriptAction, ScriptSandbox
from device_agent.runtime.errors import Refused
from tests.harness.agent.sandbox import warm_sandbox


class RecordingApi:
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
            case script_calls.GetState():
                return {"position_rad": {"shoulder": 0.1, "elbow": 0.2}, "mode": "action"}
            case _:
                self.received.append(call)
        return None


class RecordedOutput:
    def __init__(self) -> None:
        self.printed = ""
        self.progress: list[float] = []

    def __call__(self, text: str, share: float | None) -> None:
        self.printed += text
        if share is not None:
            self.progress.append(share)


class FakeProcess:
    """A process with preset messages."""

    def __init__(self, *, exits: bool = True) -> None:
        self.link, self.script_end = socket.socketpair()
        self.exits = exits
        self.killed = False

    def send(self, *lines: bytes) -> None:
        self.script_end.sendall(b"".join(line + b"\n" for line in lines))

    def kill(self) -> None:
        self.killed = True

    def wait(self, timeout_s: float) -> bool:
        del timeout_s
        return self.exits

    def ending(self) -> str:
        return "it crashed"

    def close(self) -> None:
        self.link.close()
        self.script_end.close()


class FakeSandbox:
    def __init__(self, process: FakeProcess | None) -> None:
        self.process = process

    def open(self, limits: Limits, *, untrusted: bool) -> FakeProcess:
        del limits, untrusted
        if self.process is None:
            raise SandboxError("no process can be started for the script")
        return self.process


class Run:
    """A script action, its calls and its output.

    Without ``sandbox``, a real sandbox runs the script.
    """

    def __init__(
        self,
        source: str = "",
        parameters: dict[str, Any] | None = None,
        *,
        sandbox: Any = None,
        on_exit: Callable[[], None] = lambda: None,
    ) -> None:
        self.api, self.output = RecordingApi(), RecordedOutput()
        digest = hashlib.sha256(source.encode()).hexdigest()
        request = RunMovement(
            robot_type="test", name="wave", version=1, sha256=digest, source=source, parameters=parameters or {}
        )
        self.script = ScriptAction(
            request,
            self.api,
            self.output,
            sandbox=ScriptSandbox(sandbox or warm_sandbox(), untrusted=False),
            on_exit=on_exit,
        )


def run(source: str, parameters: dict[str, Any] | None = None) -> tuple[RecordingApi, RecordedOutput]:
    started = Run(source, parameters)
    started.script.run()
    return started.api, started.output


def run_fake(process: FakeProcess | None) -> RecordedOutput:
    started = Run(sandbox=FakeSandbox(process))
    started.script.run()
    return started.output

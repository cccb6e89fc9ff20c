"""Runs a movement script in a sandboxed process, and responds to its calls."""

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import msgspec

from device_agent.ports import script_calls
from device_agent.ports.sandbox import Limits, Sandbox, SandboxError, SandboxProcess
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol import RunMovement
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.errors import Refused

MAX_OUTPUT = 2000
"""Characters of printed output in an ack; older ones are dropped."""
_MESSAGES_PER_S = 500.0
_BYTES_PER_MESSAGE = 1024
"""Rate limit of a script's messages. A script that exceeds it waits, so that it cannot exhaust the agent's CPU."""
_BURST = 500.0
_READY_TIMEOUT_S = 30.0
_WRITE_TIMEOUT_S = 5.0
"""A process that does not read its responses is ended after this time [s]."""
_EXIT_CHECK_S = 60.0
_CHUNK = 65_536


class RobotApiProtocol(Protocol):
    """Device operations that a script calls."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names in order."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames that can be moved to a pose."""

    @property
    def calls(self) -> tuple[str, ...]:
        """Names of the script API's methods that this robot supports."""

    def execute(self, call: script_calls.Call) -> Any:
        """Execute a call to its end; returns its result as plain JSON.

        Raises:
            Refused: The call failed.
        """


class ScriptFailed(Exception):  # noqa: N818 (an outcome to report)
    """The script ended with an error; the text names its line."""


@dataclass(frozen=True, slots=True)
class ScriptSandbox:
    """Sandbox and limits of a script, and whether its author is untrusted."""

    sandbox: Sandbox
    untrusted: bool
    limits: Limits = field(default_factory=Limits)


class ScriptAction:
    """One run of one movement script.

    Args:
        request: Source, name and parameters.
        robot: Executes the script's calls.
        on_output: Called with new printed output and the progress 0…1, or ``None``.
        sandbox: Runs the script.
        on_exit: Called from another thread when the process has exited. It must stop the motion.
    """

    def __init__(
        self,
        request: RunMovement,
        robot: RobotApiProtocol,
        on_output: Callable[[str, float | None], None],
        *,
        sandbox: ScriptSandbox,
        on_exit: Callable[[], None],
    ) -> None:
        self._request = request
        self._robot = robot
        self._on_output = on_output
        self._sandbox = sandbox
        self._on_exit = on_exit
        self._killed = threading.Event()
        self._over = threading.Event()
        self._process: SandboxProcess | None = None

    def run(self) -> None:
        """Run the script to its end.

        Raises:
            ScriptFailed: The script raised, or its process ended.
        """
        try:
            process = self._sandbox.sandbox.open(self._sandbox.limits, untrusted=self._sandbox.untrusted)
        except SandboxError as error:
            raise ScriptFailed(str(error)) from error
        self._process = process
        watcher = SupervisedThread(partial(self._watch, process), name="script-watch", part="watch of a script")
        with contextlib.closing(process):
            if self._killed.is_set():
                process.kill()
            watcher.start()
            try:
                self._serve(process)
            finally:
                self._over.set()
                process.kill()
                watcher.join(_WRITE_TIMEOUT_S)

    def kill(self) -> None:
        """End the process, from any thread; ``run`` then raises. May be called twice."""
        # No lock: the control loop may call this, and must not wait for the start of a process.
        self._killed.set()
        if self._process is not None:
            self._process.kill()

    def _watch(self, process: SandboxProcess) -> None:
        """Wait for the exit in a separate thread: the serving thread may be busy with a call."""
        while not process.wait(_EXIT_CHECK_S):
            if self._over.is_set():
                return
        self._on_exit()

    def _serve(self, process: SandboxProcess) -> None:
        reader = _LineReader(process.link, self._killed)
        try:
            self._send_script(process.link, reader)
            while True:
                try:
                    message = script_calls.parse(reader.read())
                except ProtocolError as error:
                    _write(process.link, error=str(error)[:MAX_OUTPUT])
                    continue
                if isinstance(message, script_calls.Ended):
                    break
                self._handle(process.link, message)
        except (OSError, EOFError) as error:
            raise ScriptFailed(f"the script's process ended before the script did{_exit_reason(process)}") from error
        if message.error:
            raise ScriptFailed(message.error[:MAX_OUTPUT])

    def _send_script(self, link: socket.socket, reader: "_LineReader") -> None:
        """Send the script after the process has confirmed its confinement."""
        try:
            first = script_calls.parse(reader.read(timeout_s=_READY_TIMEOUT_S))
        except ProtocolError as error:
            raise EOFError from error
        if isinstance(first, script_calls.Unfit):
            raise ScriptFailed(f"the script was not run, the sandbox is incomplete: {first.reason[:MAX_OUTPUT]}")
        _write(
            link,
            source=self._request.source,
            name=self._request.name,
            parameters=self._request.parameters,
            joints=self._robot.joints,
            frames=self._robot.frames,
            can=self._robot.calls,
        )

    def _handle(self, link: socket.socket, message: script_calls.Message) -> None:
        match message:
            case script_calls.Output(text=text):
                self._on_output(text[-MAX_OUTPUT:], None)
            case script_calls.Progress(share=share):
                self._on_output("", share)
            case script_calls.Ready() | script_calls.Unfit() | script_calls.Ended():
                _write(link, error="this message may be sent only once")
            case _:
                try:
                    result = self._robot.execute(message)
                except Refused as refused:
                    _write(link, error=refused.message)
                else:
                    _write(link, value=result)


class _LineReader:
    """Reads lines of bounded length at a bounded rate."""

    def __init__(self, link: socket.socket, killed: threading.Event) -> None:
        self._link = link
        self._killed = killed
        self._buffer = b""
        self._credit = _BURST
        self._updated_s = time.monotonic()

    def read(self, *, timeout_s: float | None = None) -> bytes:
        """The next line, without its end.

        Raises:
            EOFError: The process has ended, the line is too long, or there was no data within ``timeout_s`` [s].
            OSError: The same.
        """
        while b"\n" not in self._buffer:
            too_long = len(self._buffer) >= script_calls.MAX_LINE
            if too_long or not select.select([self._link], [], [], timeout_s)[0]:
                raise EOFError
            chunk = self._link.recv(_CHUNK)
            if not chunk:
                raise EOFError
            self._buffer += chunk
        line, _, self._buffer = self._buffer.partition(b"\n")
        if len(line) >= script_calls.MAX_LINE:
            raise EOFError
        self._throttle(1 + len(line) / _BYTES_PER_MESSAGE)
        return line

    def _throttle(self, cost: float) -> None:
        now_s = time.monotonic()
        self._credit = min(_BURST, self._credit + (now_s - self._updated_s) * _MESSAGES_PER_S) - cost
        self._updated_s = now_s
        if self._credit < 0:
            self._killed.wait(-self._credit / _MESSAGES_PER_S)


def _write(link: socket.socket, **message: Any) -> None:
    link.settimeout(_WRITE_TIMEOUT_S)
    try:
        link.sendall(msgspec.json.encode(message) + b"\n")
    finally:
        link.settimeout(None)


def _exit_reason(process: SandboxProcess) -> str:
    """Why the process ended, if it is known."""
    exited = process.wait(_WRITE_TIMEOUT_S)
    why = process.ending() if exited else "it stopped following the protocol"
    return f": {why}" if why else ""

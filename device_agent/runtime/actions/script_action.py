"""Runs a movement script in a locked process, and answers what comes out of it."""

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec

from device_agent.ports import script_calls
from device_agent.ports.sandbox import JailError, Limits, Sandbox, SandboxProcess
from device_agent.protocol import RunMovement
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.errors import Refused

MAX_OUTPUT = 2000
"""Characters of printed output that an ack carries; of more, the newest are kept."""
_MESSAGES_PER_S = 500.0
_BYTES_PER_MESSAGE = 1024
"""A script that says more than that is read more slowly: it waits, the agent's processor does not boil."""
_BURST = 500.0
_READY_S = 30.0
_WRITE_S = 5.0
"""A process that does not read the answers it asked for is ended after this time."""
_LOOK_S = 60.0
_PIECE = 65_536


class RobotApiProtocol(Protocol):
    """What a script's calls reach."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names in order."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames that can be brought somewhere."""

    @property
    def can(self) -> tuple[str, ...]:
        """Names of the calls that this robot has."""

    def do(self, call: script_calls.Call) -> Any:
        """Do what was asked, to its end; gives the answer, plain JSON.

        Raises:
            Refused: It was not done.
        """


class ScriptFailed(Exception):  # noqa: N818 (an outcome to report)
    """The script ended with an error; the text names its line."""


@dataclass(frozen=True, slots=True)
class Cell:
    """Where a script runs: jail and limits, and whether it is a ``stranger``, a script of an unknown owner."""

    jail: Sandbox
    stranger: bool
    limits: Limits = field(default_factory=Limits)


class Script:
    """One run of one movement script.

    Args:
        order: Source, name and parameters.
        reach: What its calls reach.
        told: Called with what the script printed last and its progress 0…1, if it gave one.
        cell: Where it runs.
        died: Called, from another thread, once its process is dead, however it ended: what it moves must not go on.
    """

    def __init__(
        self,
        order: RunMovement,
        reach: RobotApiProtocol,
        told: Callable[[str, float | None], None],
        *,
        cell: Cell,
        died: Callable[[], None],
    ) -> None:
        self._order = order
        self._reach = reach
        self._told = told
        self._cell = cell
        self._died = died
        self._killed = threading.Event()
        self._over = threading.Event()
        self._inmate: SandboxProcess | None = None

    def run(self) -> None:
        """Run to the end.

        Raises:
            ScriptFailed: The script raised, or its process died.
        """
        try:
            self._inmate = inmate = self._cell.jail.open(self._cell.limits, stranger=self._cell.stranger)
        except JailError as error:
            raise ScriptFailed(str(error)) from error
        watch = threading.Thread(target=self._watch, args=(inmate,), name="script-watch", daemon=True)
        with contextlib.closing(inmate):
            if self._killed.is_set():
                inmate.kill()
            watch.start()
            try:
                self._serve(inmate)
            finally:
                self._over.set()
                inmate.kill()
                watch.join(_WRITE_S)

    def kill(self) -> None:
        """End the process at once, from any thread; ``run`` then raises. May be called twice."""
        # No lock: the control loop may call this, and must not wait for a process to be started.
        self._killed.set()
        if self._inmate is not None:
            self._inmate.kill()

    def _watch(self, inmate: SandboxProcess) -> None:
        """Whoever serves the script may be busy with its last call for as long as a move takes."""
        while not inmate.wait(_LOOK_S):
            if self._over.is_set():
                return
        self._died()

    def _serve(self, inmate: SandboxProcess) -> None:
        lines = _Lines(inmate.link, self._killed)
        try:
            self._send_script(inmate.link, lines)
            while True:
                try:
                    message = script_calls.parse(lines.read())
                except ProtocolError as error:
                    _write(inmate.link, error=str(error)[:MAX_OUTPUT])
                    continue
                if isinstance(message, script_calls.Ended):
                    break
                self._take(inmate.link, message)
        except (OSError, EOFError) as error:
            raise ScriptFailed(f"the script's process ended before the script did{_because(inmate)}") from error
        if message.error:
            raise ScriptFailed(message.error[:MAX_OUTPUT])

    def _send_script(self, link: socket.socket, lines: "_Lines") -> None:
        """Once the jail is known to hold."""
        try:
            first = script_calls.parse(lines.read(within_s=_READY_S))
        except ProtocolError as error:
            raise EOFError from error
        if isinstance(first, script_calls.Unfit):
            raise ScriptFailed(f"the script was not run, the jail does not hold: {first.reason[:MAX_OUTPUT]}")
        _write(
            link,
            source=self._order.source,
            name=self._order.name,
            parameters=self._order.parameters,
            joints=self._reach.joints,
            frames=self._reach.frames,
            can=self._reach.can,
        )

    def _take(self, link: socket.socket, message: script_calls.Message) -> None:
        match message:
            case script_calls.Output(text=text):
                self._told(text[-MAX_OUTPUT:], None)
            case script_calls.Progress(share=share):
                self._told("", share)
            case script_calls.Ready() | script_calls.Unfit() | script_calls.Ended():
                _write(link, error="this is said once")
            case _:
                try:
                    answer = self._reach.do(message)
                except Refused as refused:
                    _write(link, error=refused.message)
                else:
                    _write(link, value=answer)


class _Lines:
    """Reads lines, of bounded length and at a bounded rate."""

    def __init__(self, link: socket.socket, killed: threading.Event) -> None:
        self._link = link
        self._killed = killed
        self._rest = b""
        self._credit = _BURST
        self._at_s = time.monotonic()

    def read(self, *, within_s: float | None = None) -> bytes:
        """The next line, without its end.

        Raises:
            EOFError: The process has ended, or sends a line without end, or nothing ``within_s`` [s].
            OSError: The same.
        """
        while b"\n" not in self._rest:
            if len(self._rest) >= script_calls.MAX_LINE or not _readable(self._link, within_s):
                raise EOFError
            piece = self._link.recv(_PIECE)
            if not piece:
                raise EOFError
            self._rest += piece
        line, _, self._rest = self._rest.partition(b"\n")
        if len(line) >= script_calls.MAX_LINE:
            raise EOFError
        self._pay(1 + len(line) / _BYTES_PER_MESSAGE)
        return line

    def _pay(self, price: float) -> None:
        now_s = time.monotonic()
        self._credit = min(_BURST, self._credit + (now_s - self._at_s) * _MESSAGES_PER_S) - price
        self._at_s = now_s
        if self._credit < 0:
            self._killed.wait(-self._credit / _MESSAGES_PER_S)


def _readable(link: socket.socket, within_s: float | None) -> bool:
    return bool(select.select([link], [], [], within_s)[0])


def _write(link: socket.socket, **message: Any) -> None:
    link.settimeout(_WRITE_S)
    try:
        link.sendall(msgspec.json.encode(message) + b"\n")
    finally:
        link.settimeout(None)


def _because(inmate: SandboxProcess) -> str:
    """Why it died, as far as that can be known."""
    inmate_died = inmate.wait(_WRITE_S)
    why = inmate.ending() if inmate_died else "it stopped making sense"
    return f": {why}" if why else ""

"""Port: runs movement scripts in confined processes that can only communicate with the agent."""

import socket
from dataclasses import dataclass
from typing import Literal, Protocol


class SandboxError(Exception):
    """A script cannot be run safely, or at all. The message names the remedy."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Resources of one script.

    Attributes:
        cpu_s: Processor time [s].
        memory_bytes: Address space [bytes]; Python and NumPy need about 110 MB. The kernel needs time to reclaim memory
            after a Stop: 12 to 30 ms for a process of 256 MB, 30 to 75 ms for one of 512 MB (measured).
    """

    cpu_s: int = 120
    memory_bytes: int = 256 * 2**20


@dataclass(frozen=True, slots=True)
class SandboxStatus:
    """How scripts run on this machine.

    Attributes:
        mode: ``sandboxed``: with all layers. ``unconfined``: with fewer layers, as the owner allows. ``unavailable``:
            not at all.
        reason: What is missing, and the remedy; empty for ``sandboxed``.
    """

    mode: Literal["sandboxed", "unconfined", "unavailable"]
    reason: str = ""


class SandboxProcess(Protocol):
    """The confined process of one script.

    Attributes:
        link: The agent's end of the process's only socket (a stream). Its first line reports whether the process is
            confined.
    """

    link: socket.socket

    def kill(self) -> None:
        """Kill the process, from any thread; never blocks. May be called repeatedly."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until the process has ended, at most ``timeout_s`` [s]. Returns whether it has."""

    def ending(self) -> str:
        """Why the process ended; empty after a normal exit or ``kill``."""

    def close(self) -> None:
        """Kill the process, wait for its end and release its resources. May be called repeatedly."""


class Sandbox(Protocol):
    """Creates sandbox processes. Thread-safe; the constructor starts no process."""

    def start(self) -> None:
        """Detect the features of this machine and prepare a process. Never raises; see ``refusal``."""

    def status(self) -> SandboxStatus:
        """How scripts of the agent's owner run here."""

    def refusal(self, *, untrusted: bool) -> str | None:
        """Why scripts cannot run here, with the remedy, or ``None`` if they can.

        Scripts are ``untrusted`` if the author is not the agent's owner; they need an additional layer.
        """

    def open(self, limits: Limits, *, untrusted: bool) -> SandboxProcess:
        """Start a confined process that waits for its script.

        Raises:
            SandboxError: There is a ``refusal``, or the process cannot be started.
        """

    def close(self) -> None:
        """Kill all processes. May be called repeatedly."""

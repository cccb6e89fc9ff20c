"""Where movement scripts run: in processes that can do nothing but speak to the agent. The implementer's manual."""

import socket
from dataclasses import dataclass
from typing import Literal, Protocol


class JailError(Exception):
    """A script cannot be run safely, or at all. Its text says what to do."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What one script may use.

    Attributes:
        cpu_s: Processor time [s].
        memory_bytes: Address space, of which Python and NumPy take about 110 MB. The kernel needs the time of a Stop to
            take it back: a process that has filled 256 MB is dead 12 to 30 ms after its kill, one of 512 MB 30 to 75.
    """

    cpu_s: int = 120
    memory_bytes: int = 256 * 2**20


@dataclass(frozen=True, slots=True)
class SandboxStatus:
    """How scripts run on this machine.

    Attributes:
        how: In the jail with all its layers; with fewer, since the owner trusts them; or not at all.
        why: What is missing, and what to do about it; empty where they are ``sandboxed``.
    """

    how: Literal["sandboxed", "unconfined", "unavailable"]
    why: str = ""


class SandboxProcess(Protocol):
    """The locked process of one script.

    Attributes:
        link: The agent's end of its only socket (a stream). Its first line says whether the jail holds.
    """

    link: socket.socket

    def kill(self) -> None:
        """End it at once, whatever it does about signals. From any thread, never blocks, may be called twice."""

    def wait(self, timeout_s: float) -> bool:
        """Whether it is dead within that time [s]."""

    def ending(self) -> str:
        """Once it is dead: why, if that was not of its own will or by ``kill``; else empty."""

    def close(self) -> None:
        """Kill it, see it dead, and let go of it. May be called twice."""


class Sandbox(Protocol):
    """Makes inmates. Thread-safe; the constructor starts nothing."""

    def start(self) -> None:
        """Look what this machine has, and be ready. May be called twice. Never raises: ``refusal`` tells."""

    def standing(self) -> SandboxStatus:
        """How scripts of the robot's own people run here."""

    def refusal(self, *, stranger: bool) -> str | None:
        """Why scripts are refused here, and what to do about it; ``None`` where they run.

        Args:
            stranger: Whether it is a script of an unknown owner, which needs one wall more.
        """

    def open(self, limits: Limits, *, stranger: bool) -> SandboxProcess:
        """A new locked process, which waits for its script.

        Raises:
            JailError: There is a ``refusal``, or the process could not be made.
        """

    def close(self) -> None:
        """End all inmates. May be called twice."""

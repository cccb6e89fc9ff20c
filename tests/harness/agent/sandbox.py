"""One jail for all tests of a process that run scripts: it is warm after the first. And none, for those that do not."""

import atexit
from functools import cache
from typing import Literal

from device_agent.ports.sandbox import JailError, Limits, SandboxProcess, SandboxStatus
from device_agent.sandbox.host import SandboxHost

LACK = "no seccomp; install libseccomp2"


@cache
def warm_sandbox() -> SandboxHost:
    """The real one, with every layer."""
    jail = SandboxHost()
    jail.start()
    atexit.register(jail.close)
    return jail


class LateJail(SandboxHost):
    """The real one, which starts its first process for the first script only: for agents that live a moment."""

    def standing(self) -> SandboxStatus:
        return SandboxStatus("sandboxed")


class NoSandbox:
    """A machine on which no script runs; starts no process."""

    def __init__(self, how: Literal["unconfined", "unavailable"] = "unavailable") -> None:
        self._how = how

    def start(self) -> None:
        pass

    def standing(self) -> SandboxStatus:
        return SandboxStatus(self._how, LACK)

    def refusal(self, *, stranger: bool) -> str | None:
        del stranger
        return LACK

    def open(self, limits: Limits, *, stranger: bool) -> SandboxProcess:
        del limits, stranger
        raise JailError(LACK)

    def close(self) -> None:
        pass

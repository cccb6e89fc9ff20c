"""A shared running sandbox for each test process, and an unavailable one for tests without scripts."""

import atexit
from functools import cache
from typing import Literal

from device_agent.ports.sandbox import Limits, SandboxError, SandboxProcess, SandboxStatus
from device_agent.sandbox.host import SandboxHost

LACK = "no seccomp; install libseccomp2"


@cache
def warm_sandbox() -> SandboxHost:
    """The real sandbox with every layer."""
    sandbox = SandboxHost()
    sandbox.start()
    atexit.register(sandbox.close)
    return sandbox


class LateSandbox(SandboxHost):
    """The real sandbox, started by the first script; for agents that run briefly."""

    def status(self) -> SandboxStatus:
        return SandboxStatus("sandboxed")


class NoSandbox:
    """A sandbox that rejects every script and starts no process."""

    def __init__(self, mode: Literal["unconfined", "unavailable"] = "unavailable") -> None:
        self._mode = mode

    def start(self) -> None:
        pass

    def status(self) -> SandboxStatus:
        return SandboxStatus(self._mode, LACK)

    def refusal(self, *, untrusted: bool) -> str | None:
        del untrusted
        return LACK

    def open(self, limits: Limits, *, untrusted: bool) -> SandboxProcess:
        del limits, untrusted
        raise SandboxError(LACK)

    def close(self) -> None:
        pass

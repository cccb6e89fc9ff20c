"""Permission to restart the agent: given only while all devices are at rest, and only for a limited time."""

import secrets
import time
from collections.abc import Callable
from typing import Protocol

PERMISSION_S = 30.0
"""Time for which the agent rejects motion after it has agreed to a restart [s]."""
SUSPENDED = "the agent is about to restart for an update; take control again in a minute"


class Suspendable(Protocol):
    """The part of an agent that ``RestartPermission`` uses."""

    def suspend(self, why: str) -> str:
        """See ``Agent.suspend``."""

    def resume(self) -> None:
        """See ``Agent.resume``."""


class RestartPermission:
    """The present permission. Not thread-safe: one thread calls all methods, and ``expire`` several times a second.

    From ``request`` until the permission ends, every device rejects motion. A new request replaces the permission, so
    that a program that lost its token can ask again.

    Attributes:
        confirmed: Whether the agent must now end; it rejects motion until then.
    """

    def __init__(self, agent: Suspendable, *, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._agent = agent
        self._clock_s = clock_s
        self._token = ""
        self._until_s = 0.0
        self.confirmed = False

    def request(self) -> tuple[str, str]:
        """Ask for a permission. Returns its token and an empty string, or an empty token and what prevents it."""
        if self.confirmed:
            return "", "the agent restarts already"
        self._end()
        reason = self._agent.suspend(SUSPENDED)
        if reason:
            return "", reason
        self._token = secrets.token_hex(16)
        self._until_s = self._clock_s() + PERMISSION_S
        return self._token, ""

    def confirm(self, token: str) -> bool:
        """Use the permission: the agent must end now. Returns False if it has expired."""
        self.expire()
        self.confirmed = self.confirmed or self._valid(token)
        return self.confirmed and self._valid(token)

    def cancel(self, token: str) -> bool:
        """Return the permission unused. Returns False if it has expired or was used."""
        if self.confirmed or not self._valid(token):
            return False
        self._end()
        return True

    def expire(self) -> None:
        """Allow motion again if the permission has expired unused."""
        if self._token and not self.confirmed and self._clock_s() >= self._until_s:
            self._end()

    def _valid(self, token: str) -> bool:
        return bool(self._token) and secrets.compare_digest(token.encode(), self._token.encode())

    def _end(self) -> None:
        if self._token:
            self._token = ""
            self._agent.resume()

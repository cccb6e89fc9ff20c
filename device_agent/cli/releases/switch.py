"""The switch to another release: only with the agent's permission, and undone if the release does not prove itself."""

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from device_agent.cli.local_control import client
from device_agent.cli.local_control.messages import ControlRequest, ControlResponse
from device_agent.cli.releases.installation import Installation, PendingTrial
from device_agent.cli.releases.trial import FAILED, PASSED
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore

_POLL_S = 1.0
_RESULT_POLL_S = 0.2
_STARTS = 4
"""Starts until the launcher gives up a release that ends at once, with the pauses of the service manager."""
_SPARE_S = 60.0


class SwitchError(ConfigError):
    """The release was not switched, or was switched back; the text states what is in use."""


class Switch:
    """Switches an installation to another complete and checked release.

    Args:
        installation: Locked by the caller.
        wait_s: Time to wait for a device to come to rest [s].
        trial_s: Time for the proof that the release works [s].
    """

    def __init__(self, installation: Installation, *, wait_s: float, trial_s: float) -> None:
        self._installation = installation
        self._wait_s = wait_s
        self._trial_s = trial_s

    def to(self, version: str) -> str:
        """Switch; returns what happened.

        Raises:
            SwitchError: The agent did not come to rest, or the release failed and the former one is in use again.
        """
        home = self._installation.home
        deadline_s = time.monotonic() + self._wait_s
        shown = ""
        while True:
            answer = client.call(home, ControlRequest(kind="request-restart"))
            if answer is None:
                return self._switch_stopped(version)
            if answer.ok:
                if (trial := self._switch_running(version, answer)) is not None:
                    return self._await_result(trial)
                answer = ControlResponse(ok=False, version="", reason="the permission to restart expired")
            if answer.reason != shown:
                shown = answer.reason
                _say(f"waiting: {shown}")
            if time.monotonic() >= deadline_s:
                raise SwitchError(
                    f"not switched after {self._wait_s:g} s: {shown}. Release {version} is ready; try again later"
                )
            time.sleep(_POLL_S)

    def _switch_running(self, version: str, permission: ControlResponse) -> PendingTrial | None:
        """Switch while the agent rejects motion, and let it end. Undone if its permission has expired."""
        installation, token = self._installation, permission.token
        trial = self._link(version, needs_link=permission.linked)
        try:
            answer = client.call(installation.home, ControlRequest(kind="confirm-restart", token=token))
        except ConfigError:
            answer = None  # unknown: the agent may end or not; a release that is not on trial is safe in both cases
        if answer is not None and answer.ok:
            return trial
        installation.undo(trial)
        return None

    def _switch_stopped(self, version: str) -> str:
        """Switch while no agent runs. The release is on trial from its next start."""
        with self._no_agent_runs():
            self._link(version, needs_link=False)
        return f"release {version} is in use from the next start of the agent, which was not running"

    def _link(self, version: str, *, needs_link: bool) -> PendingTrial:
        installation = self._installation
        current, before = installation.linked("current"), installation.linked("previous")
        trial = PendingTrial.new(version, needs_link=needs_link, timeout_s=self._trial_s, before=before)
        installation.write_trial(trial)
        installation.link("previous", current)
        installation.link("current", version)
        return trial

    @contextlib.contextmanager
    def _no_agent_runs(self) -> Iterator[None]:
        home = self._installation.home
        if not (home / "identity.pem").exists():
            yield
            return
        with contextlib.ExitStack() as stack:
            with _rights_of_owner(home):
                stack.enter_context(IdentityStore(home).lock())
            yield

    def _await_result(self, trial: PendingTrial) -> str:
        installation = self._installation
        _say(f"switched to release {trial.version}; waiting for its proof")
        deadline_s = time.monotonic() + _STARTS * trial.timeout_s + _SPARE_S
        while time.monotonic() < deadline_s:
            result, reason = installation.result(trial)
            if result == PASSED:
                installation.end_trial()
                return f"release {trial.version} is in use and works"
            if result == FAILED:
                former = installation.undo(trial)
                raise SwitchError(f"release {trial.version} failed ({reason}); release {former} is in use again")
            time.sleep(_RESULT_POLL_S)
        raise SwitchError(
            f"the agent was not started again. Start its service: release {trial.version} is checked then, and the "
            "former release is used if the check fails"
        )


@contextlib.contextmanager
def _rights_of_owner(home: Path) -> Iterator[None]:
    """Open files with the rights of the folder's owner, so that a link in the folder gains nothing from root."""
    if os.geteuid() != 0:
        yield
        return
    status = home.stat()
    umask = os.umask(0o077)
    os.setegid(status.st_gid)
    os.seteuid(status.st_uid)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(0)
        os.umask(umask)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)

"""Behaviours of the controller: recoveries, and programs that are stored on it, over the dashboard server."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from device_agent.drivers.behaviour_names import encode
from device_agent.drivers.ur import modes
from device_agent.drivers.ur.connection import Measurement
from device_agent.drivers.ur.dashboard import Dashboard
from device_agent.ports.skills import BehaviourContext, RobotBehaviour, SkillError

UNLOCK_S = 5.0
"""The controller does not release a protective stop earlier [s]. Source: *Dashboard Server*."""
_MARGIN_S = 0.2
_CONFIRM_S = 60.0
"""Longest time until the controller has executed a command [s]; an arm needs some of it to start."""
_POLL_S = 0.05
_STOP_S = 5.0
PROGRAM, RECOVERY = "program", "recovery"
"""Kinds of the behaviours' names."""

Newest = Callable[[], Measurement | None]
"""The newest measurement, or ``None`` while the controller is not connected."""


@dataclass(frozen=True, slots=True)
class _Recovery:
    """A command that removes a fault and moves no joint.

    Attributes:
        command: Command of the dashboard.
        accepts: Start of the controller's response.
        title: Name for operators.
        confirmed: Whether a measurement shows that the controller has executed it; ``None``: the response does.
    """

    command: str
    accepts: str
    title: str
    confirmed: Callable[[Measurement], bool] | None = None


_RECOVERIES = {
    encode(RECOVERY, each.command.replace(" ", "_")): each
    for each in (
        _Recovery(
            "unlock protective stop",
            "protective stop releasing",
            "Unlock protective stop",
            lambda newest: newest.safety_mode != modes.PROTECTIVE_STOP,
        ),
        _Recovery("close safety popup", "closing safety popup", "Close safety popup"),
        _Recovery("power on", "powering on", "Power on", lambda newest: newest.robot_mode in modes.POWERED),
        _Recovery(
            "brake release", "brake releasing", "Release brakes", lambda newest: newest.robot_mode == modes.RUNNING
        ),
    )
}


class UrBehaviours:
    """What operators may start at one controller.

    Args:
        dashboard: The controller's dashboard server.
        programs: Paths of the programs on the controller that its owner permits.
        newest: The newest measurement.
    """

    def __init__(self, dashboard: Dashboard, programs: Sequence[str], newest: Newest) -> None:
        self._dashboard = dashboard
        self._programs = {encode(PROGRAM, path): path for path in programs}
        self._newest = newest
        self.all = (
            *(RobotBehaviour(name, recovery.title, recovery=True) for name, recovery in _RECOVERIES.items()),
            *(RobotBehaviour(name, path) for name, path in self._programs.items()),
        )

    def program(self, name: str) -> str | None:
        """Path of the program with this name; ``None`` for a recovery.

        Raises:
            SkillError: The behaviour is unknown.
        """
        if name in _RECOVERIES:
            return None
        if name not in self._programs:
            known = ", ".join(each.title for each in self.all)
            raise SkillError(f"no behaviour '{name[:80]}'; the robot has: {known}; agent.toml lists its programs")
        return self._programs[name]

    def recover(self, name: str, context: BehaviourContext) -> None:
        """Execute a recovery, and wait until the controller has executed it.

        Raises:
            SkillError: The controller rejects it, or does not execute it.
        """
        recovery = _RECOVERIES[name]
        if recovery.confirmed is not None and self._newest() is None:
            raise SkillError("the controller is not connected; check its power, the network and remote control")
        if name == encode(RECOVERY, "unlock_protective_stop") and not self._wait_for_unlock(context):
            return
        self._dashboard.execute(recovery.command, accepts=recovery.accepts)
        if recovery.confirmed is not None:
            self._confirm(recovery.title, recovery.confirmed, context)

    def load(self, path: str) -> None:
        """Load and start a program.

        Raises:
            SkillError: The controller rejects it.
        """
        self._dashboard.execute(f"load {path}", accepts="loading program")
        self._dashboard.execute("play", accepts="starting program")

    def wait_for_program(self, context: BehaviourContext, halted: Callable[[], bool]) -> str:
        """Wait until the controller runs no program any more; stop it with the action. Returns an error.

        Raises:
            SkillError: The controller does not stop it.
        """
        started, start_s = False, time.monotonic()
        while not (context.wait(_POLL_S) or halted()):
            newest = self._newest()
            if newest is None:
                return "the connection is lost; the program may still run"
            fault = modes.fault(newest.safety_mode, newest.robot_mode)
            if fault is not None:
                break
            if newest.runtime_state != modes.STOPPED:
                started = True
            elif started or time.monotonic() - start_s > _STOP_S:
                return "" if started else "the controller did not start the program"
        self.stop_program()
        return "the program was stopped before its end"

    def stop_program(self) -> None:
        """Stop the running program, and wait until the controller has stopped it.

        Raises:
            SkillError: The controller does not stop it.
        """
        end_s = time.monotonic() + _STOP_S
        self._dashboard.execute("stop", accepts="stopp")
        while (newest := self._newest()) is not None and newest.runtime_state != modes.STOPPED:
            if time.monotonic() > end_s:
                raise SkillError("the controller does not stop the program; press its emergency stop")
            time.sleep(_POLL_S)

    def _wait_for_unlock(self, context: BehaviourContext) -> bool:
        """Wait until the protective stop is old enough; returns False if there is none or the action has ended."""
        while (newest := self._newest()) is not None and newest.safety_mode == modes.PROTECTIVE_STOP:
            if newest.time_s - newest.protective_s >= UNLOCK_S + _MARGIN_S:
                return True
            if context.wait(_POLL_S):
                return False
        return False

    def _confirm(self, title: str, confirmed: Callable[[Measurement], bool], context: BehaviourContext) -> None:
        end_s = time.monotonic() + _CONFIRM_S
        while (newest := self._newest()) is None or not confirmed(newest):
            if context.wait(_POLL_S):
                return
            if time.monotonic() > end_s:
                raise SkillError(f"'{title}' had no effect within {_CONFIRM_S:.0f} s; look at the robot's screen")

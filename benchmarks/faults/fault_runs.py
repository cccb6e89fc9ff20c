"""One fault after another: time until a moving arm rests, and time until recovery."""

import contextlib
import signal
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Final

import msgspec

from benchmarks.faults.action_load import ActionLoad, count_returns, false_results, rests
from benchmarks.faults.crowd import CROWD, Crowd
from benchmarks.faults.injection import DISK_FULL, Injection
from benchmarks.faults.operator import FULL_SPEED, FaultOperator
from benchmarks.faults.processes import ACTION_ARM, STREAMING_ARM, ProductProcesses
from tests.faults import cuts
from tests.faults.cuts import Bench, Repair
from tests.faults.judge import Verdict, judge
from tests.faults.stack import now_ms
from tests.harness.network.brokers import wait_until

_KILLED: Final = "console killed"
"""Additional fault that stops the arm if the fault itself does not."""
_CUTS: Final = {
    "operator killed": _KILLED,
    "operator's link cut": "operator disconnected",
    "operator's link silent": "operator's link dropped",
    "agent's link cut": "agent disconnected",
    "agent's link silent": "agent's link dropped",
    "agent's link stalls": "agent's link stalls",
    "broker killed": "broker killed",
    "functions killed": "functions killed",
}
_DETECTED_BY_AGENT: Final = ("agent's link cut", "broker killed")
"""The agent detects these faults, so times count from the cut and not from the last setpoint."""
_SHUFFLED: Final = "all sent twice, out of order"
_AGENT_KILLED: Final = "agent killed"
_DISTANT: Final = "operator's link: 300 ms round trip, stalls of 2 s"
_ATTEMPTS: Final = 8
_DISTANT_RTT_MS: Final = 300.0
_STALL_S: Final = 2.0
_RECOVERY_TIMEOUT_S: Final = 60.0
_BEFORE_CUT_MS: Final = 400.0


class FaultResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one run.

    Attributes:
        stop_ms: Time from the last setpoint at the agent to the first trace line without commanded motion; None if
            the trace ends with the agent.
        recovery_s: Time from the repair until a new lease moves the arm and the other arm completes a new action.
        moved_again: True if anything moved between the stop and a new lease.
        reordered: Number of setpoints applied after a newer one.
    """

    fault: str
    broker: str
    stop_ms: float | None
    recovery_s: float
    moved_again: bool
    reordered: int = 0


class FaultRuns(Bench):
    """Runs one fault at a time."""

    def __init__(self, product: ProductProcesses, load: ActionLoad, *, seed: int) -> None:
        super().__init__(product, seed=seed)
        self.product = product
        self.load = load
        self.arm, self._wrist = self.arms
        self.arms = [self.arm]
        self._begun_ms = self._repaired_ms = 0.0
        self.crowd = Crowd(product)
        self._faults = Injection(product, self.crowd).faults
        self._untraced_ms: list[tuple[float, float]] = []
        """Times between a full disk, which ends the simulation's trace, or an exit, and the next start of the agent."""
        self._ended_ms: list[float] = []
        """Times at which the agent was killed."""

    @property
    def names(self) -> list[str]:
        """Names of all faults."""
        return [*_CUTS, _DISTANT, _SHUFFLED, *self._faults, _AGENT_KILLED]

    def close(self) -> None:
        """Stops the operators and closes the traces."""
        self.arms = [self.arm, self._wrist]
        super().close()

    def round(self, fault: str) -> FaultResult:
        """Runs one fault until recovery."""
        self.load.fault = fault
        verdict, reordered = None, 0
        if fault in _CUTS:
            verdict = self._cut(_CUTS[fault])
        elif fault == _DISTANT:
            verdict = self._distant()
        elif fault == _SHUFFLED:
            verdict, reordered = self._shuffled()
        elif fault == _AGENT_KILLED:
            self._kill_agent()
        else:
            if fault == CROWD:
                self.crowd.populate()
            verdict = self._during_fault(*self._faults[fault], by_recorder=fault == DISK_FULL)
        recovery_s = round(self._recover(), 2)
        if fault == DISK_FULL:
            self._restart_agent()
        return FaultResult(
            fault=fault,
            broker=self.product.kind,
            stop_ms=None
            if verdict is None
            else round(verdict.cut_ms if fault in _DETECTED_BY_AGENT else verdict.rest_ms, 1),
            recovery_s=recovery_s,
            moved_again=verdict is not None and verdict.moved_again,
            reordered=reordered,
        )

    def compare_actions(self) -> tuple[int, list[str]]:
        """Compares the actions of the other arm with the trace: number of repeated ones, and false results."""
        targets_rad = {each.number: self.load.target_rad(each.number) for each in self.load.actions}
        visits = list(rests(self._wrist.record.read(), targets_rad))
        traced = [
            each
            for each in self.load.actions
            if not any(begin_ms <= each.requested_ms <= end_ms for begin_ms, end_ms in self._untraced_ms)
        ]
        first_ms = {number: at_ms for at_ms, number in reversed(visits)}
        return count_returns(number for _, number in visits), list(false_results(traced, first_ms, self._ended_ms))

    # ------------------------------------------------------------ rounds

    def _cut(self, cut: str) -> Verdict:
        for _ in range(_ATTEMPTS):
            if cut in cuts.OPERATOR:
                found = self._operator_round(self.arm, cut, self.rng).verdict
            else:
                found = self._round_of_all(cut)[0].verdict
            if found.in_motion:
                break
        return found

    def _cut_operator(self, arm: cuts.Arm, cut: str) -> Repair:
        return self._timed(super()._cut_operator(arm, cut))

    def _cut_all(self, cut: str) -> Repair:
        return self._timed(super()._cut_all(cut))

    def _timed(self, repair: Repair) -> Repair:
        """Records the time of the repair; for a fault without repair, the time of the fault."""
        self._repaired_ms = now_ms()

        def timed() -> None:
            if repair is not cuts.no_repair:
                self._repaired_ms = now_ms()
            repair()

        return timed

    def _distant(self) -> Verdict:
        """Gives the link of an operator a long round trip while the arm moves, and stalls it.

        The agent refuses setpoints of such an age, so the arm must rest and stay at rest.
        """
        for _ in range(_ATTEMPTS):
            self._set_in_motion()
            time.sleep(self.rng.uniform(0.0, 0.6))
            self.product.operator_network.set(rtt_ms=_DISTANT_RTT_MS)
            cut_ms = now_ms()
            time.sleep(self.rng.uniform(0.6, 1.2))
            thaw = super()._cut_operator(self.arm, cuts.STALLS)
            time.sleep(_STALL_S)
            thaw()
            time.sleep(0.5)
            found = self.arm.verdict(cuts.STALLS, cut_ms, self._last_applied_ms(cut_ms))
            self._repaired_ms = now_ms()
            self.product.operator_network.set(rtt_ms=0.0)
            if found.in_motion:
                break
        return found

    def _last_applied_ms(self, cut_ms: float) -> float:
        """Returns the time of the last period after a cut that applied a new setpoint."""
        periods = self.product.recorder.since(STREAMING_ARM, cut_ms)
        return max((later.at_ms for one, later in pairwise(periods) if later.sequence > one.sequence), default=cut_ms)

    def _during_fault(
        self, begin: Callable[[], object], repair: Callable[[], object], *, by_recorder: bool
    ) -> Verdict | None:
        """Kills the operator during a fault and returns the effect; None if the fault ended the agent.

        ``by_recorder``: the trace has ended; use the recorded periods.
        """
        for _ in range(_ATTEMPTS):
            self._set_in_motion()
            self._begun_ms = now_ms()
            begin()
            time.sleep(self.rng.uniform(0.5, 0.9))
            assert self.arm.console is not None
            self.arm.console.signal(signal.SIGKILL)
            cut_ms = now_ms()
            time.sleep(0.7)
            since_ms = self.arm.last_setpoint_ms(cut_ms)
            cut_ms = min(cut_ms, since_ms)  # the fault may have ended the setpoints before
            if self.product.agent.exited:
                self._untraced_ms.append((self._begun_ms, now_ms()))
                found = None
            elif by_recorder:
                found = judge(
                    self.product.recorder.rows(STREAMING_ARM, cut_ms - _BEFORE_CUT_MS), cut_ms=cut_ms, since_ms=since_ms
                )
            else:
                found = self.arm.verdict(_KILLED, cut_ms, since_ms)
            self._repaired_ms = now_ms()
            repair()
            self.arm.close_console()
            if found is None or found.in_motion:
                break
        return found

    def _shuffled(self) -> tuple[Verdict, int]:
        """Sends setpoints twice and out of order, and repeats commands to the other arm in reversed pairs."""
        self.arm.close_console()
        topic = f"{self.product.topic(ACTION_ARM)}/cmd"
        started_ms = now_ms()
        with (
            self.product.allowed("bench-repeat", publish=(topic,), subscribe=(topic,)) as client,
            FaultOperator(self.product, FULL_SPEED, shuffled=True) as operator,
        ):
            commands: list[bytes] = []
            client.on_payload = commands.append
            operator.await_motion()
            time.sleep(self.rng.uniform(0.8, 1.2))
            client.on_payload = lambda _payload: None
            for first in range(0, len(commands), 2):
                for payload in reversed(commands[first : first + 2]):
                    client.client.publish(topic, payload, 1)
            operator.stop_streaming()
            cut_ms = now_ms()
            time.sleep(0.7)
        self._repaired_ms = now_ms()
        verdict = self.arm.verdict(_KILLED, cut_ms, self.arm.last_setpoint_ms(cut_ms))
        sequences = [
            each.sequence
            for each in self.product.recorder.since(STREAMING_ARM, started_ms)
            if each.epoch == operator.epoch
        ]
        return verdict, sum(later < earlier for earlier, later in pairwise(sequences))

    def _kill_agent(self) -> None:
        self._set_in_motion()
        self.product.signal(self.product.agent, signal.SIGKILL)
        self._ended_ms.append(now_ms())
        time.sleep(0.3)
        self._repaired_ms = now_ms()
        self.product.restart(self.product.agent)

    def _restart_agent(self) -> None:
        """Starts a new trace after a full disk."""
        self.product.signal(self.product.agent, signal.SIGKILL)
        self.product.restart(self.product.agent)
        self._recover()
        self._untraced_ms.append((self._begun_ms, now_ms()))

    def _set_in_motion(self) -> None:
        """Takes control and moves the arm; repeats it while the product has not recovered."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(AssertionError):
                if self.arm.set_in_motion():
                    return
        raise TimeoutError("the arm cannot be moved")

    def _recover(self) -> float:
        self._set_in_motion()
        moving_ms = now_ms()
        wait_until(lambda: self.load.done_since(self._repaired_ms), "a new completed action", _RECOVERY_TIMEOUT_S)
        done_ms = self.load.done_since(self._repaired_ms)
        assert done_ms is not None
        return (max(moving_ms, done_ms) - self._repaired_ms) / 1000

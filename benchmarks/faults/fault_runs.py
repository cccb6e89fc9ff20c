"""One fault after another: time until a moving arm rests, and time until recovery."""

import os
import resource
import signal
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Final

import msgspec

from benchmarks.faults.action_load import ActionLoad, count_returns
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
_DISK_FULL: Final = "agent's disk full"
_ATTEMPTS: Final = 8
_RTT_MS: Final = 100.0
_LOSS: Final = 0.02
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
        self._repaired_ms = 0.0
        self._faults: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
            "100 ms round trip": (lambda: self._network(rtt_ms=_RTT_MS), self._network),
            "2 % packet loss, retransmitted after 200 ms": (lambda: self._network(loss=_LOSS), self._network),
            "agent's clock an hour ahead": (lambda: self._clock(signal.SIGUSR1), lambda: self._clock(signal.SIGUSR2)),
            "agent's clock an hour back": (lambda: self._clock(signal.SIGUSR2), lambda: self._clock(signal.SIGUSR1)),
            _DISK_FULL: (lambda: self._disk(full=True), lambda: self._disk(full=False)),
        }

    @property
    def names(self) -> list[str]:
        """Names of all faults. The full disk ends the simulation's trace; the killed agent starts a new one."""
        return [*_CUTS, _SHUFFLED, *self._faults, _AGENT_KILLED]

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
        elif fault == _SHUFFLED:
            verdict, reordered = self._shuffled()
        elif fault == _AGENT_KILLED:
            self._kill_agent()
        else:
            verdict = self._during_fault(*self._faults[fault], by_recorder=fault == _DISK_FULL)
        return FaultResult(
            fault=fault,
            broker=self.product.kind,
            stop_ms=None
            if verdict is None
            else round(verdict.cut_ms if fault in _DETECTED_BY_AGENT else verdict.rest_ms, 1),
            recovery_s=round(self._recover(), 2),
            moved_again=verdict is not None and verdict.moved_again,
            reordered=reordered,
        )

    def count_repeated_actions(self) -> int:
        """Counts repeated actions of the other arm in the trace."""
        return count_returns([row.target_rad[-1] for row in self._wrist.record.read()])

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

    def _during_fault(self, begin: Callable[[], object], repair: Callable[[], object], *, by_recorder: bool) -> Verdict:
        """Kills the operator during a fault; ``by_recorder``: the trace has ended, use the recorded periods."""
        for _ in range(_ATTEMPTS):
            while not self.arm.set_in_motion():
                pass
            begin()
            time.sleep(self.rng.uniform(0.5, 0.9))
            assert self.arm.console is not None
            self.arm.console.signal(signal.SIGKILL)
            cut_ms = now_ms()
            time.sleep(0.7)
            since_ms = self.arm.last_setpoint_ms(cut_ms)
            if by_recorder:
                found = judge(
                    self.product.recorder.rows(STREAMING_ARM, cut_ms - _BEFORE_CUT_MS), cut_ms=cut_ms, since_ms=since_ms
                )
            else:
                found = self.arm.verdict(_KILLED, cut_ms, since_ms)
            self._repaired_ms = now_ms()
            repair()
            self.arm.close_console()
            if found.in_motion:
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
        while not self.arm.set_in_motion():
            pass
        self.product.signal(self.product.agent, signal.SIGKILL)
        time.sleep(0.3)
        self._repaired_ms = now_ms()
        self.product.restart(self.product.agent)

    def _recover(self) -> float:
        while not self.arm.set_in_motion():
            pass
        moving_ms = now_ms()
        wait_until(lambda: self.load.done_since(self._repaired_ms), "a new completed action", _RECOVERY_TIMEOUT_S)
        done_ms = self.load.done_since(self._repaired_ms)
        assert done_ms is not None
        return (max(moving_ms, done_ms) - self._repaired_ms) / 1000

    # ------------------------------------------------------------ fault injection

    def _network(self, *, rtt_ms: float = 0.0, loss: float = 0.0) -> None:
        self.product.network.set(rtt_ms=rtt_ms, loss=loss)

    def _clock(self, number: int) -> None:
        """Sends the signal to the agent's own process."""
        os.kill(self.product.pid(self.product.agent), number)

    def _disk(self, *, full: bool) -> None:
        """Limits the file size of the agent to zero, so each write fails as on a full disk."""
        process = self.product.pid(self.product.agent)
        _, hard = resource.prlimit(process, resource.RLIMIT_FSIZE)
        resource.prlimit(process, resource.RLIMIT_FSIZE, (0 if full else hard, hard))

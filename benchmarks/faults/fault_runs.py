"""One fault after another: time until a moving arm rests, and time until recovery."""

import os
import resource
import signal
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Final

import msgspec

from benchmarks.faults.action_load import ActionLoad, went_back
from benchmarks.faults.operator import FULL, FaultOperator
from benchmarks.faults.processes import ORDERED, STREAMED, ProductProcesses
from tests.faults import cuts
from tests.faults.cuts import Bench, Mend
from tests.faults.judge import Verdict, judge
from tests.faults.stack import now_ms
from tests.harness.network.brokers import wait_until

_KILLED: Final = "console killed"
"""Additional fault that stops the arm if the fault itself does not."""
_CUTS: Final = {
    "operator killed": _KILLED,
    "operator's link cut": "operator cut off",
    "operator's link silent": "operator's link forgotten",
    "agent's link cut": "agent cut off",
    "agent's link silent": "agent's link forgotten",
    "agent's link stalls": "agent's link stalls",
    "broker killed": "broker killed",
    "functions killed": "functions killed",
}
_TOLD: Final = ("agent's link cut", "broker killed")
"""The agent notices these faults itself, so times count from the cut and not from the last setpoint."""
_SHUFFLED: Final = "all sent twice, out of order"
_AGENT_KILLED: Final = "agent killed"
_DISK_FULL: Final = "agent's disk full"
_TRIES: Final = 8
_RTT_MS: Final = 100.0
_LOSS: Final = 0.02
_RECOVERS_S: Final = 60.0
_LOOK_MS: Final = 400.0


class FaultResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one run.

    Attributes:
        stop_ms: Time from the last setpoint at the agent to the first trace line without commanded motion; None if
            the trace ends with the agent.
        recovery_s: Time from the repair until a new lease moves the arm and the other arm completes a new action.
        moved_again: True if anything moved between the stop and a new lease.
        undone: Number of setpoints applied after a newer one.
    """

    fault: str
    broker: str
    stop_ms: float | None
    recovery_s: float
    moved_again: bool
    undone: int = 0


class FaultRuns(Bench):
    """Runs one fault at a time."""

    def __init__(self, ground: ProductProcesses, orders: ActionLoad, *, seed: int) -> None:
        super().__init__(ground, seed=seed)
        self.ground = ground
        self.orders = orders
        self.arm, self._wrist = self.arms
        self.arms = [self.arm]
        self._mended_ms = 0.0
        self._faults: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
            "100 ms of round trip": (lambda: self._network(rtt_ms=_RTT_MS), self._network),
            "2 % lost, sent again after 200 ms": (lambda: self._network(loss=_LOSS), self._network),
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
        self.orders.fault = fault
        verdict, undone = None, 0
        if fault in _CUTS:
            verdict = self._cut(_CUTS[fault])
        elif fault == _SHUFFLED:
            verdict, undone = self._shuffled()
        elif fault == _AGENT_KILLED:
            self._kill_agent()
        else:
            verdict = self._while_wrong(*self._faults[fault], noted=fault == _DISK_FULL)
        return FaultResult(
            fault=fault,
            broker=self.ground.kind,
            stop_ms=None if verdict is None else round(verdict.cut_ms if fault in _TOLD else verdict.rest_ms, 1),
            recovery_s=round(self._recover(), 2),
            moved_again=verdict is not None and verdict.moved_again,
            undone=undone,
        )

    def wrist_went_back(self) -> int:
        """Counts repeated actions of the other arm in the trace."""
        return went_back([row.target_rad[-1] for row in self._wrist.record.read()])

    # ------------------------------------------------------------ rounds

    def _cut(self, cut: str) -> Verdict:
        for _ in range(_TRIES):
            if cut in cuts.OPERATOR:
                found = self._operator_round(self.arm, cut, self.chance).verdict
            else:
                found = self._round_of_all(cut)[0].verdict
            if found.in_motion:
                break
        return found

    def _cut_operator(self, arm: cuts.Arm, cut: str) -> Mend:
        return self._timed(super()._cut_operator(arm, cut))

    def _cut_all(self, cut: str) -> Mend:
        return self._timed(super()._cut_all(cut))

    def _timed(self, mend: Mend) -> Mend:
        """Records the time of the repair; a fault that repairs itself starts to do so at once."""
        self._mended_ms = now_ms()

        def timed() -> None:
            if mend is not cuts.mends_itself:
                self._mended_ms = now_ms()
            mend()

        return timed

    def _while_wrong(self, begin: Callable[[], object], mend: Callable[[], object], *, noted: bool) -> Verdict:
        """Kills the operator while a fault is active; ``noted``: the trace has ended, use the recorded periods."""
        for _ in range(_TRIES):
            while not self.arm.set_in_motion():
                pass
            begin()
            time.sleep(self.chance.uniform(0.5, 0.9))
            assert self.arm.console is not None
            self.arm.console.signal(signal.SIGKILL)
            cut_ms = now_ms()
            time.sleep(0.7)
            since_ms = self.arm.last_setpoint_ms(cut_ms)
            if noted:
                found = judge(self.ground.noted.rows(STREAMED, cut_ms - _LOOK_MS), cut_ms=cut_ms, since_ms=since_ms)
            else:
                found = self.arm.verdict(_KILLED, cut_ms, since_ms)
            self._mended_ms = now_ms()
            mend()
            self.arm.leave()
            if found.in_motion:
                break
        return found

    def _shuffled(self) -> tuple[Verdict, int]:
        """Sends setpoints twice and out of order, and repeats commands to the other arm in reversed pairs."""
        self.arm.leave()
        topic = f"{self.ground.topic(ORDERED)}/cmd"
        began_ms = now_ms()
        with (
            self.ground.allowed("bench-again", publish=(topic,), subscribe=(topic,)) as line,
            FaultOperator(self.ground, FULL, shuffled=True) as hand,
        ):
            heard: list[bytes] = []
            line.on_payload = heard.append
            hand.await_motion()
            time.sleep(self.chance.uniform(0.8, 1.2))
            line.on_payload = lambda _payload: None
            for first in range(0, len(heard), 2):
                for payload in reversed(heard[first : first + 2]):
                    line.client.publish(topic, payload, 1)
            hand.let_go()
            cut_ms = now_ms()
            time.sleep(0.7)
        self._mended_ms = now_ms()
        verdict = self.arm.verdict(_KILLED, cut_ms, self.arm.last_setpoint_ms(cut_ms))
        taken = [each.sequence for each in self.ground.noted.since(STREAMED, began_ms) if each.epoch == hand.epoch]
        return verdict, sum(later < earlier for earlier, later in pairwise(taken))

    def _kill_agent(self) -> None:
        while not self.arm.set_in_motion():
            pass
        self.ground.signal(self.ground.agent, signal.SIGKILL)
        time.sleep(0.3)
        self._mended_ms = now_ms()
        self.ground.revive(self.ground.agent)

    def _recover(self) -> float:
        while not self.arm.set_in_motion():
            pass
        moving_ms = now_ms()
        wait_until(lambda: self.orders.done_since(self._mended_ms), "an order to be done again", _RECOVERS_S)
        done_ms = self.orders.done_since(self._mended_ms)
        assert done_ms is not None
        return (max(moving_ms, done_ms) - self._mended_ms) / 1000

    # ------------------------------------------------------------ fault injection

    def _network(self, *, rtt_ms: float = 0.0, loss: float = 0.0) -> None:
        self.ground.network.set(rtt_ms=rtt_ms, loss=loss)

    def _clock(self, number: int) -> None:
        """Sends the signal to the agent's own process."""
        os.kill(self.ground.pid(self.ground.agent), number)

    def _disk(self, *, full: bool) -> None:
        """Limits the file size of the agent to zero, so each write fails as on a full disk."""
        process = self.ground.pid(self.ground.agent)
        _, hard = resource.prlimit(process, resource.RLIMIT_FSIZE)
        resource.prlimit(process, resource.RLIMIT_FSIZE, (0 if full else hard, hard))

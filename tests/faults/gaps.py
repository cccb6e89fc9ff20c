"""Interrupts the setpoints of a moving arm for a short time, under one lease.

The operator continues its old input after each gap, with fresh telemetry. The arm must rest in time, must not move
again until the operator presses the slider anew, and must then move under the same epoch.
"""

import random
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from tests.faults.cuts import Arm, cut_operator
from tests.faults.judge import MOST_MS, Verdict, quantile
from tests.faults.stack import Console, Stack, now_ms

GAPS = ("console stopped", "operator's link stalls")
SHORTEST_S, LONGEST_S = 0.2, 5.0
_CERTAIN_S = 0.6
"""A shorter gap may end before the watchdog reacts: on a busy machine the last setpoint arrives late."""
_CONTINUED_S = 0.6
"""Time for which the old input continues after the gap."""


@dataclass(frozen=True, slots=True)
class Gap:
    """One gap.

    Attributes:
        held: Whether the agent ended the input.
        resumed: Whether a new input moved the arm under the same epoch.
    """

    kind: str
    arm: str
    seconds: float
    held: bool
    resumed: bool
    verdict: Verdict

    @property
    def broken(self) -> bool:
        if not self.resumed:
            return True
        if self.seconds > _CERTAIN_S:
            return not (self.held and self.verdict.met_limit)
        return self.held and self.verdict.rest_ms <= MOST_MS and self.verdict.moved_again


def inject(stack: Stack, gaps: int, *, seed: int) -> list[Gap]:
    """Inject this number of gaps, on all arms in parallel."""
    arms = [Arm(stack, name) for name in stack.names]
    rng = random.Random(seed)
    seeds = [(arm, rng.random(), gaps // len(arms) + (index < gaps % len(arms))) for index, arm in enumerate(arms)]
    try:
        with ThreadPoolExecutor(len(arms)) as pool:
            return [gap for found in pool.map(lambda each: _inject(*each), seeds) for gap in found]
    finally:
        for arm in arms:
            arm.close_console()
            arm.record.close()


def table(gaps: list[Gap]) -> str:
    """Times from the last setpoint to zero commanded velocity."""
    held = [gap for gap in gaps if gap.held]
    rest = [gap.verdict.rest_ms for gap in held]
    figures = f"rest p50 {quantile(rest, 0.5):.0f} ms, p99 {quantile(rest, 0.99):.0f} ms, max {max(rest):.0f} ms"
    late = sum(each > MOST_MS for each in rest)
    return f"{len(gaps)} gaps, {len(held)} held, {sum(gap.resumed for gap in gaps)} resumed, {figures}, {late} late"


def _inject(arm: Arm, seed: float, gaps: int) -> list[Gap]:
    rng = random.Random(seed)
    while not arm.set_in_motion(stubborn=True):
        pass
    found: list[Gap] = []
    while len(found) < gaps:
        gap = _gap(arm, GAPS[len(found) % len(GAPS)], rng)
        # The watchdog holds no arm that rests or reverses at the moment of the gap, so its input remains: repeat.
        if gap.verdict.in_motion or not gap.resumed:
            found.append(gap)
    return found


def _gap(arm: Arm, kind: str, rng: random.Random) -> Gap:
    console = arm.console
    assert console is not None
    epoch, _ = _status(console)
    time.sleep(rng.uniform(0, 0.6))
    seconds = rng.uniform(SHORTEST_S, LONGEST_S)
    repair = cut_operator(arm, kind)
    cut_ms = now_ms()
    time.sleep(seconds)
    repair()
    time.sleep(_CONTINUED_S)
    verdict = arm.verdict(kind, cut_ms, arm.last_setpoint_ms(cut_ms))
    _, held = _status(console)
    resumed = arm.sweep() and _status(console)[0] == epoch is not None
    return Gap(kind, arm.name, seconds, held, resumed, verdict)


def _status(console: Console) -> tuple[int | None, bool]:
    console.send("status")
    status = console.receive("input_ended", within_s=10)
    assert status is not None, "the operator does not answer"
    return status["epoch"], status["input_ended"]

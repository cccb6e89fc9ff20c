"""Interrupts the connections and processes behind a moving arm and measures when the arm came to rest.

In each round an operator takes control and sweeps the arm. At a random time one component is interrupted.
During the interruption and after the repair, the arm must not move until an operator takes control again.
The trace of the simulation is the measurement.
"""

import contextlib
import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import httpx

from infra.local.supervisor import SupervisedProcess
from tests.faults.judge import MOST_MS, Record, Verdict, judge, quantile
from tests.faults.stack import MOVEMENT, PATIENCE_S, Console, Stack, now_ms

Repair = Callable[[], None]
STALLS = "operator's link stalls"
OPERATOR = ("console killed", "console stopped", "operator disconnected", STALLS, "operator's link dropped")
SCRIPT = ("script's processes killed",)
SHARED = (
    "agent disconnected", "agent's link stalls", "agent's link dropped", "broker killed", "broker stopped",
    "functions killed", "functions stopped", "agent stopped",
)  # fmt: skip
WATCHED = (*OPERATOR, "agent's link stalls", "agent's link dropped", "broker stopped")
"""Interruptions that the agent detects only by its watchdog."""
LEASE_MS = 30_000
SHORT_LEASE_MS = 1_500
_MAX_SETPOINT_AGE_MS = 200.0
"""Maximum age of a setpoint that the agent accepts [ms]. On a busy machine one may arrive after a cut."""
_CONTEXT_MS = 400.0
_REPORTED_STARVATION_MS = 10.0
_SCRIPT_START_S = 0.4
"""Time until the first move of a script is at speed [s]."""


@dataclass(frozen=True, slots=True)
class Result:
    """The result of one arm at one cut."""

    cut: str
    arm: str
    verdict: Verdict


@dataclass
class Tally:
    """Results of all cuts.

    Attributes:
        cuts: Number of cuts of each kind with an arm in motion.
        repeated: Rounds without motion at the cut; they are repeated.
    """

    results: list[Result] = field(default_factory=list)
    cuts: dict[str, int] = field(default_factory=dict)
    repeated: int = 0

    @property
    def broken(self) -> list[Result]:
        return [each for each in self.results if not each.verdict.met_limit]

    @property
    def late(self) -> list[Result]:
        """Results above the limit, including those of a starved machine."""
        return [each for each in self.results if each.verdict.rest_ms > MOST_MS]

    @property
    def count(self) -> int:
        return sum(self.cuts.values())

    def add(self, cut: str, results: list[Result]) -> bool:
        """Count a cut. Returns True if an arm was in motion."""
        moving = [each for each in results if each.verdict.in_motion]
        self.results += moving
        if not moving:
            self.repeated += 1
            return False
        self.cuts[cut] = self.cuts.get(cut, 0) + 1
        return True

    def table(self) -> Iterator[str]:
        """Markdown table of times to zero commanded velocity, since the last permission to move and since the cut."""
        yield "| cut | cuts | arms in motion | p50 ms | p99 ms | max ms | from the cut, max ms | starved | broken |"
        yield "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
        for cut in (*self.cuts, "all"):
            verdicts = [each.verdict for each in self.results if cut in (each.cut, "all")]
            rest = [each.rest_ms for each in verdicts]
            starved = sum(each.starved_ms > _REPORTED_STARVATION_MS for each in verdicts)
            broken = sum(not each.met_limit for each in verdicts)
            figures = (quantile(rest, 0.5), quantile(rest, 0.99), max(rest), max(each.cut_ms for each in verdicts))
            cells = " | ".join(f"{figure:.0f}" for figure in figures)
            cuts = self.count if cut == "all" else self.cuts[cut]
            yield f"| {cut} | {cuts} | {len(verdicts)} | {cells} | {starved} | {broken} |"


class Arm:
    """One arm, its record and its operator."""

    def __init__(self, stack: Stack, name: str) -> None:
        self.stack = stack
        self.name = name
        self.record = Record(stack.trace / f"{name}.ndjson")
        self.console: Console | None = None
        self.kind = (0, False)

    def open_console(self, lease_ms: int = LEASE_MS, *, stubborn: bool = False) -> Console:
        """Return an operator of this kind; start a new one if needed."""
        if self.console is None or self.kind != (lease_ms, stubborn):
            self.close_console()
            self.console = self.stack.console(self.name, lease_ms=lease_ms, stubborn=stubborn)
            self.kind = (lease_ms, stubborn)
        return self.console

    def close_console(self) -> None:
        if self.console is not None:
            self.console.end()
            self.console = None

    def set_in_motion(self, lease_ms: int = LEASE_MS, *, stubborn: bool = False) -> bool:
        """Take control and sweep. Returns True if the arm moves."""
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            console = self.open_console(lease_ms, stubborn=stubborn)
            console.send("take")
            granted = console.receive("granted", "rejected", within_s=10)
            if granted is None:
                self.close_console()
            elif granted.get("confirmed"):
                break
            time.sleep(0.1)
        else:
            raise AssertionError(f"{self.name}: no control within {PATIENCE_S} s")
        return self.sweep()

    def sweep(self) -> bool:
        """Start a new input that sweeps. Returns True if the arm moves."""
        console = self.console
        assert console is not None
        for _ in range(20):
            console.send("sweep")
            message = console.receive("moving", "lost", "ended", within_s=3)
            if message != {"ended": "no-telemetry"}:
                return message is not None and "moving" in message
            time.sleep(0.1)
        return False

    def run_script(self) -> bool:
        """Sweep the arm by a script. Returns True if the script runs."""
        device = f"/devices/{self.stack.agent_id}-{self.name}"
        try:
            epoch = self.stack.post(f"{device}/lease", lease_ms=LEASE_MS, wait_ms=2_000)["epoch"]
            request = {"kind": "run_movement", "name": MOVEMENT}
            action = self.stack.post(f"{device}/actions", request=request, epoch=epoch, wait_ms=10_000)
        except httpx.HTTPError:
            return False
        time.sleep(_SCRIPT_START_S)
        return bool(action["status"] == "started")

    def verdict(self, cut: str, cut_ms: float, since_ms: float, *, begin_ms: float | None = None) -> Verdict:
        """Judge the motion until now; ``begin_ms`` is the time of the last free motion if it is not the cut."""
        end_ms, begin_ms = now_ms(), cut_ms if begin_ms is None else begin_ms
        rows = [row for row in self.record.read() if begin_ms - _CONTEXT_MS <= row.tick_ms <= end_ms]
        self.record.discard(end_ms - _CONTEXT_MS)
        return judge(rows, cut_ms=cut_ms, since_ms=since_ms, watched=cut in WATCHED)

    def last_setpoint_ms(self, cut_ms: float) -> float:
        """Time at which the agent received the last setpoint sent before the cut."""
        setpoints_ms = self.stack.setpoints[self.name]
        self.stack.setpoints[self.name] = setpoints_ms[-200:]
        return max((at_ms for at_ms in setpoints_ms if at_ms <= cut_ms + _MAX_SETPOINT_AGE_MS), default=cut_ms)


def cut_operator(arm: Arm, cut: str) -> Repair:
    """Interrupt the operator of an arm. Returns the repair."""
    console = arm.console
    assert console is not None
    match cut:
        case "console killed":
            console.signal(signal.SIGKILL)
            return arm.close_console
        case "console stopped":
            console.signal(signal.SIGSTOP)
            return lambda: console.signal(signal.SIGCONT)
        case "operator disconnected":
            console.proxy.cut()
            console.proxy.freeze()
            return console.proxy.thaw
        case "operator's link stalls":
            console.proxy.freeze()
            return console.proxy.thaw
        case "operator's link dropped":
            console.proxy.swallow()
            return arm.close_console
    raise AssertionError(cut)


class Bench:
    """Runs rounds and counts the results."""

    def __init__(self, stack: Stack, *, seed: int) -> None:
        self.stack = stack
        self.rng = random.Random(seed)
        self.arms = [Arm(stack, name) for name in stack.names]
        self.tally = Tally()

    def close(self) -> None:
        for arm in self.arms:
            arm.close_console()
            arm.record.close()

    def cut_each_operator(self, rounds: int) -> None:
        """Run this number of rounds on each arm in parallel."""
        rngs = [random.Random(self.rng.random()) for _ in self.arms]

        def run_rounds(arm: Arm, rng: random.Random) -> None:
            for number in range(rounds):
                cut = OPERATOR[(number + self.arms.index(arm)) % len(OPERATOR)]
                while not self.tally.add(cut, [self._operator_round(arm, cut, rng)]):
                    pass

        with ThreadPoolExecutor(len(self.arms)) as pool:
            for done in [pool.submit(run_rounds, arm, rng) for arm, rng in zip(self.arms, rngs, strict=True)]:
                done.result()

    def cut_all_arms(self, cut: str) -> None:
        """Make one cut that affects all arms."""
        while not self.tally.add(cut, self._round_of_all(cut)):
            pass

    # ------------------------------------------------------------ rounds

    def _operator_round(self, arm: Arm, cut: str, rng: random.Random) -> Result:
        while not arm.set_in_motion():
            pass
        time.sleep(rng.uniform(0, 0.6))
        repair = self._cut_operator(arm, cut)
        cut_ms = now_ms()
        time.sleep(rng.uniform(0.45, 0.9))
        repair()
        time.sleep(0.5)
        return Result(cut, arm.name, arm.verdict(cut, cut_ms, arm.last_setpoint_ms(cut_ms)))

    def _cut_operator(self, arm: Arm, cut: str) -> Repair:
        return cut_operator(arm, cut)

    def _round_of_all(self, cut: str) -> list[Result]:
        functions, script = cut.startswith("functions"), cut in SCRIPT
        stubborn = functions and self.rng.random() < 0.5

        def begin(arm: Arm) -> bool:
            if script:
                return arm.run_script()
            return arm.set_in_motion(SHORT_LEASE_MS if functions else LEASE_MS, stubborn=stubborn)

        with ThreadPoolExecutor(len(self.arms)) as pool:
            list(pool.map(begin, self.arms))
        time.sleep(self.rng.uniform(0, 0.6))
        repair = self._cut_all(cut)
        cut_ms = now_ms()
        time.sleep(self.rng.uniform(0.45, 1.2) + functions * SHORT_LEASE_MS / 1000)
        since_ms = {arm.name: self._since_ms(arm, cut, cut_ms) for arm in self.arms}
        repaired_ms = now_ms()
        repair()
        time.sleep(0.6)
        begin_ms = cut_ms
        if cut == "agent stopped":  # the stopped agent did not move; the limit counts from its resumption
            cut_ms, since_ms = repaired_ms, dict.fromkeys(since_ms, repaired_ms)
        return [
            Result(cut, arm.name, arm.verdict(cut, cut_ms, since_ms[arm.name], begin_ms=begin_ms)) for arm in self.arms
        ]

    def _since_ms(self, arm: Arm, cut: str, cut_ms: float) -> float:
        """Time from which the arm had no permission to move."""
        if cut.startswith("functions"):
            grants = [at_ms for at_ms in self.stack.commands[arm.name] if at_ms <= cut_ms + _MAX_SETPOINT_AGE_MS]
            return max(grants) + SHORT_LEASE_MS
        return cut_ms if cut in SCRIPT else arm.last_setpoint_ms(cut_ms)

    def _cut_all(self, cut: str) -> Repair:
        stack = self.stack
        target, _, kind = cut.rpartition(" ")
        match kind:
            case "stopped":
                return self._stopped(self._children[target])
            case "killed" if target in self._children:
                stack.signal(self._children[target], signal.SIGKILL)
                return lambda: self._restart(self._children[target])
            case "killed":
                for process in stack.descendants(stack.agent):
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(process, signal.SIGKILL)
                return no_repair
            case _:
                return self._cut_link(kind)

    def _cut_link(self, kind: str) -> Repair:
        link = self.stack.agent_mqtt
        match kind:
            case "disconnected":
                link.cut()
            case "dropped":
                link.swallow()
            case "stalls":
                link.freeze()
                return link.thaw
        return no_repair

    @property
    def _children(self) -> dict[str, SupervisedProcess]:
        return {"broker": self.stack.broker, "functions": self.stack.functions, "agent": self.stack.agent}

    def _stopped(self, child: SupervisedProcess) -> Repair:
        self.stack.signal(child, signal.SIGSTOP)
        return lambda: self.stack.signal(child, signal.SIGCONT)

    def _restart(self, child: SupervisedProcess) -> None:
        self.stack.restart(child)
        self.stack.await_health()


def no_repair() -> None:
    """No repair is needed."""

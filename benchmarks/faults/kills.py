"""Kills one program of a supervised product after another while an arm executes actions.

The product runs as ``make up`` starts it, so its supervisor restarts killed programs. A killed supervisor ends all
programs; the benchmark starts it again, as a service manager does.
"""

import contextlib
import math
import os
import random
import signal
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, Self

import msgspec

from benchmarks.faults.action_load import ActionLoad, count_returns, duplicated, false_results, lost, rests
from benchmarks.faults.recorder import Recorder
from tests.faults.judge import Record
from tests.faults.stack import now_ms
from tests.harness.browser.product import PORTS, Api, Machine, start_program
from tests.harness.network.brokers import BrokerKind, wait_until
from tests.harness.network.ports import free_port

SUPERVISOR: Final = "supervisor"
AGENT: Final = "agent"
BROKER: Final = "broker"
PROGRAMS: Final = {
    "worker": "function_app work",
    "functions": "function_app serve",
    BROKER: "--websocket-port",
    AGENT: "benchmarks.faults.agent",
    SUPERVISOR: "",
}
"""Program → words of its command line."""
_MAX_DELAY_S: Final = 0.9
"""Longest time from the start of an action to the kill; a move takes about as long [s]."""
_RECOVERY_TIMEOUT_S: Final = 120.0
_START_ATTEMPTS: Final = 30


class KillLoad(ActionLoad):
    """Moves of about a second. The server waits for the acks of every second one; the worker stores the others."""

    @staticmethod
    def target_rad(number: int) -> float:
        """See ``ActionLoad``."""
        return number * 4e-4 + (0.9 if number % 2 else 0.0)

    @staticmethod
    def wait_ms(number: int) -> int:
        """See ``ActionLoad``."""
        return 1000 if number % 2 else 0

    def open_since_ms(self) -> float | None:
        """Returns the time of the request of the action that has not ended; None if all have."""
        newest = self.actions[-1] if self.actions else None
        return None if newest is None or newest.ended else newest.requested_ms


class Kill(msgspec.Struct, frozen=True, kw_only=True):
    """One kill.

    Attributes:
        at_ms: Time just before the kill on the monotonic clock of the machine.
        killed_ms: Time just after it; finding the process takes time.
        recovery_s: Time from the kill until a new action of each kind is completed; infinite without.
    """

    program: str
    at_ms: float
    killed_ms: float
    recovery_s: float


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """Comparison of the API with the trace of the simulation and with the starts that the agent reports."""

    accepted: int
    lost: int
    duplicated: int
    false: list[str]


class KillRuns:
    """Runs kills until the context ends.

    Args:
        kind: The broker.
        seed: Random seed of the programs and times.
        settings: Further settings of the product.
    """

    def __init__(self, kind: BrokerKind, *, seed: int, settings: Mapping[str, str] | None = None) -> None:
        self.kind = kind
        self._settings = {"TELESCOPE_BROKER": kind, **(settings or {})}
        self.kills: list[Kill] = []
        self._chance = random.Random(seed)
        self._closing = contextlib.ExitStack()
        self._product = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as on_error:
            on_error.push(self.__exit__)
            self._home = Path(self._closing.enter_context(tempfile.TemporaryDirectory(prefix="ts-")))
            self._port = free_port(PORTS)
            self._recorder = Recorder(self._home / "recorder.socket")
            self._closing.callback(self._recorder.close)
            self._machine = self._start()
            with Api(self._machine) as api:
                device = api.device("ur5")
                token = api.post("/api-keys", {"name": "bench", "role": "operator", "days": 1})["token"]
            self._trace = Record(self._home / "trace" / "ur5.ndjson")
            self._closing.callback(self._trace.close)
            api_url, path = f"{self._machine.url}/api/v1", f"/devices/{device['id']}"
            self._load = self._closing.enter_context(KillLoad(api_url, token, path, verify=self._machine.trusted))
            on_error.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()
        self._product.close()

    def run(self, count: int, log: Callable[[str], None]) -> None:
        """Kills programs in a random order in which all are equally frequent."""
        order: list[str] = []
        for number in range(count):
            if not order:
                order = self._chance.sample(list(PROGRAMS), len(PROGRAMS))
            kill = self._kill(order.pop())
            self.kills.append(kill)
            log(f"{self.kind}: {number + 1}: {kill.program} killed, recovered in {kill.recovery_s:.1f} s")

    def verdict(self) -> Verdict:
        """Ends the load, waits for the results of all actions and compares them with the trace."""
        self._load.stop()
        self._load.settle()
        actions = self._load.actions
        targets_rad = {each.number: self._load.target_rad(each.number) for each in actions}
        visits = list(rests(self._trace.read(), targets_rad))
        ended_ms = [each.killed_ms for each in self.kills if each.program in (AGENT, BROKER, SUPERVISOR)]
        return Verdict(
            accepted=sum(bool(each.id) for each in actions),
            lost=len(lost(actions)),
            duplicated=len(duplicated(actions, self._recorder.starts)) + count_returns(each for _, each in visits),
            false=list(false_results(actions, {number: at_ms for at_ms, number in reversed(visits)}, ended_ms)),
        )

    def _kill(self, program: str) -> Kill:
        wait_until(self._load.open_since_ms, "a running action", _RECOVERY_TIMEOUT_S)
        time.sleep(self._chance.uniform(0.0, _MAX_DELAY_S))
        at_ms = now_ms()
        if program == SUPERVISOR:
            os.kill(self._machine.process.pid, signal.SIGKILL)
            killed_ms = now_ms()
            self._product.close()
            self._machine = self._start()
        else:
            self._machine.kill(PROGRAMS[program])
            killed_ms = now_ms()
        recovered_ms = math.inf
        with contextlib.suppress(AssertionError):
            wait_until(lambda: self._recovered_ms(at_ms), "recovery", _RECOVERY_TIMEOUT_S)
            recovered_ms = self._recovered_ms(at_ms) or math.inf
        recovery_s = round((recovered_ms - at_ms) / 1000, 2)
        return Kill(program=program, at_ms=at_ms, killed_ms=killed_ms, recovery_s=recovery_s)

    def _recovered_ms(self, at_ms: float) -> float | None:
        """Returns the time at which new actions of both kinds had been completed; None before."""
        done = [each for each in list(self._load.actions) if each.requested_ms >= at_ms and each.status == "done"]
        times_ms = [
            min((each.done_ms for each in done if bool(self._load.wait_ms(each.number)) is waited), default=None)
            for waited in (True, False)
        ]
        return None if None in times_ms else max(each for each in times_ms if each is not None)

    def _start(self) -> Machine:
        """Starts the product; repeats it while the programs of a killed supervisor still use their ports."""
        for _ in range(_START_ATTEMPTS):
            machine = self._product.enter_context(
                start_program("benchmarks.faults.supervisor", self._home, self._port, self._settings)
            )
            if machine.process.poll() is None:
                return machine
            self._product.close()
        raise RuntimeError("".join(machine.lines))

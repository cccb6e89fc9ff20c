"""Interrupts the ingest worker while an arm executes an action, and compares the API with the simulation trace.

In each round the arm executes one action while another one is queued. An action that reached its target must be
``done`` in the API, and the queued action must run after it.
"""

import contextlib
import random
import signal
import sqlite3
import threading
import time
from dataclasses import dataclass
from typing import Any

import httpx

from tests.faults.judge import Record, quantile
from tests.faults.stack import PATIENCE_S, Stack
from tests.harness.network.brokers import wait_until

FAULTS = ("worker killed", "worker and functions killed", "worker suspended", "worker replaced")
MAX_RECOVERY_S = 10.0
"""Maximum time from the start of the worker to the stored result [s]."""
_ENDED = frozenset({"done", "failed", "expired", "cancelled"})
_FAR_RAD, _SPEED, _TIMEOUT_MS = 0.6, 0.2, 12_000
"""Target, share of the maximum speed (about 2 s for one action), and time limit of each action."""
_REACHED_RAD = 1e-3
_SENT_S = 0.3
"""Time from the journal entry of an ack until it has reached the broker, at most [s]."""


@dataclass(frozen=True, slots=True)
class Result:
    """Result of one round. ``recovery_s``: from the repair to the result of the first action [s]."""

    fault: str
    first: str
    second: str
    recovery_s: float

    @property
    def correct(self) -> bool:
        return self.first == self.second == "done"


class Settlement:
    """Rounds over one started product with the arm ``arm0``."""

    def __init__(self, stack: Stack, *, seed: int) -> None:
        self._stack = stack
        self._random = random.Random(seed)
        self._path = f"/devices/{stack.agent_id}-arm0/actions"
        self._trace = Record(stack.trace / "arm0.ndjson")
        self._side = 1.0
        self._workers = 1
        self.results: list[Result] = []

    def close(self) -> None:
        self._trace.close()

    def run(self, fault: str, *, down_s: float = 0.0) -> Result:
        """One round. ``down_s``: time from the last ack to the repair [s]; it may exceed the action's time limit."""
        first_rad, second_rad = self._side * _FAR_RAD, -self._side * _FAR_RAD
        # A waiting call stores acks as well, unless the functions are killed.
        first = self._start(first_rad, waited="functions" in fault and self._random.random() < 0.5)
        second = self._start(second_rad)
        wait_until(lambda: self._status(first) == "started", "the start of the action", PATIENCE_S)
        time.sleep(self._random.uniform(0.0, 1.0))
        repaired_s = self._interrupt(fault, first, first_rad, down_s)
        wait_until(lambda: self._status(first) in _ENDED, "the end of the action", PATIENCE_S)
        recovery_s = time.monotonic() - repaired_s
        wait_until(lambda: self._status(second) in _ENDED, "the end of the queued action", PATIENCE_S)
        result = Result(fault, self._outcome(first), self._outcome(second), recovery_s)
        if result.second == "done":
            self._reach(second, second_rad)
        else:  # the arm stays at the first target
            self._side = -self._side
        self.results.append(result)
        return result

    def table(self) -> list[str]:
        """The figures of all rounds, one line for each fault."""
        lines = []
        for fault in dict.fromkeys(each.fault for each in self.results):
            mine = [each for each in self.results if each.fault == fault]
            false = sum(each.first != "done" for each in mine)
            cancelled = sum(each.second != "done" for each in mine)
            recovery_s = [each.recovery_s for each in mine]
            lines.append(
                f"{fault}: {len(mine)} rounds, {false} false results, {cancelled} queued actions not done, recovery "
                f"p50 {quantile(recovery_s, 0.5):.1f} s, max {max(recovery_s):.1f} s"
            )
        return lines

    def _interrupt(self, fault: str, action: str, target_rad: float, down_s: float) -> float:
        """Interrupt until the arm has reached the target, then repair; returns the time of the repair [s]."""
        stack, worker = self._stack, self._stack.worker
        if fault == "worker replaced":
            self._workers += 1
            stack.worker = stack.start_worker(f"worker{self._workers}")
            time.sleep(self._random.uniform(0.0, 1.0))  # the other one may be connected or not
            started_s = time.monotonic()
            stack.signal(worker, signal.SIGKILL)
            self._reach(action, target_rad)
            return started_s
        if fault == "worker suspended":
            stack.signal(worker, signal.SIGSTOP)
            self._reach(action, target_rad)
            time.sleep(down_s)
            stack.signal(worker, signal.SIGCONT)
            return time.monotonic()
        killed = [worker, stack.functions] if fault == "worker and functions killed" else [worker]
        for child in killed:
            stack.signal(child, signal.SIGKILL)
        self._reach(action, target_rad)
        time.sleep(down_s)
        for child in killed:
            stack.restart(child)
        repaired_s = time.monotonic()
        stack.await_health()
        return repaired_s

    def _reach(self, action: str, target_rad: float) -> None:
        """Wait until the trace shows the target and the agent has sent its last ack."""

        def reached() -> bool:
            rows = self._trace.read()
            return bool(rows) and abs(rows[-1].target_rad[0] - target_rad) < _REACHED_RAD

        wait_until(reached, f"the arm at {target_rad} rad", PATIENCE_S)
        self._trace.discard(self._trace.rows[-1].tick_ms)
        journal = self._stack.agent_home / "journal.db"
        with contextlib.closing(sqlite3.connect(f"file:{journal}?mode=ro", uri=True)) as file:
            query = "SELECT terminal FROM commands WHERE id = ?"
            wait_until(lambda: file.execute(query, [action]).fetchone() == (1,), "the agent's last ack", PATIENCE_S)
        time.sleep(_SENT_S)

    def _start(self, target_rad: float, *, waited: bool = False) -> str:
        body: dict[str, Any] = {
            "request": {"kind": "move_joints", "position_rad": {"shoulder_pan": target_rad}, "speed": _SPEED},
            "policy": "queue", "timeout_ms": _TIMEOUT_MS,
        }  # fmt: skip
        if not waited:
            return str(self._stack.post(self._path, **body)["id"])
        before = self._newest()

        def call() -> None:
            with contextlib.suppress(httpx.HTTPError):
                self._stack.post(self._path, **body, wait_ms=10_000, wait_for="done")

        threading.Thread(target=call, daemon=True).start()
        wait_until(lambda: self._newest() != before, "the action", PATIENCE_S)
        return self._newest()

    def _newest(self) -> str:
        items = self._stack.http.get(self._path, params={"limit": 1}).json()["items"]
        return str(items[0]["id"]) if items else ""

    def _status(self, action: str) -> str:
        return self._outcome(action).partition(":")[0]

    def _outcome(self, action: str) -> str:
        """Status of an action, with the code of its reason; empty while the functions cannot be reached."""
        try:
            found = self._stack.http.get(f"/actions/{action}").json()
        except (httpx.HTTPError, ValueError):
            return ""
        reason = found["reason"]
        return str(found["status"]) + (f": {reason['code']}" if reason else "")

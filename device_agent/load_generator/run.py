"""One load test, from enrollment to results."""

import asyncio
import resource
import signal
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec

from device_agent.load_generator.agent import LoadAgent
from device_agent.load_generator.connection import Dialect
from device_agent.load_generator.enrollment import Enrollment, Keys
from device_agent.load_generator.kinematic_arm import Shape, robot_type
from device_agent.load_generator.metrics import Metrics
from device_agent.load_generator.options import LoadOptions, LoadTestError
from device_agent.ports.clock import CloudClock

_THREADS = 8
"""Threads for blocking calls: HTTP and connection setup."""
_SPARE_FILES = 64
_AT_ONCE = 32
"""Number of robots that publish before received data is read."""
_LAG_EVERY_S = 0.05
_LOOK_EVERY_S = 1.0
_END_WITHIN_S = 10.0


def run(plan: LoadOptions) -> int:
    """Run the load test. Returns the exit code: 0 if all agents were connected at the same time.

    Raises:
        LoadTestError: The load test cannot start.
        CloudError: The server refuses an agent.
        OSError: The server is not reached, or a file cannot be written.
    """
    _allow_files(plan.count + _SPARE_FILES)
    before_bytes = _memory_bytes()
    clock = CloudClock()
    kind = robot_type(plan.type, plan.joints, plan.rate_hz)
    register = Enrollment(plan, kind, clock)
    with ThreadPoolExecutor(_THREADS, "load-test") as pool:
        keys = Keys(plan.home).first(plan.count)
        pairings = register.all(keys, pool, _tell)
        figures = Metrics(plan.count)

        async def together() -> None:
            shape, dialect = Shape(kind), Dialect()
            members = [
                LoadAgent(
                    plan, register.api(key), pairing, shape, clock=clock, dialect=dialect, figures=figures, pool=pool
                )
                for key, pairing in zip(keys, pairings, strict=True)
            ]
            await _Crowd(plan, members, figures, before_bytes).live()

        asyncio.run(together())
    found = {"rate_hz": plan.rate_hz, "joints": plan.joints, **figures.summary(_memory_bytes() - before_bytes)}
    _write(plan, found)
    return 0 if figures.most_connected == plan.count else 1


class _Crowd:
    """All agents of one run."""

    def __init__(self, plan: LoadOptions, members: Sequence[LoadAgent], figures: Metrics, before_bytes: int) -> None:
        self._plan = plan
        self._members = members
        self._figures = figures
        self._before_bytes = before_bytes
        self._ending = asyncio.Event()

    async def live(self) -> None:
        """Connect, publish telemetry, and stop after the duration."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._ending.set)
        gap_s = self._plan.spread_s / len(self._members)
        lives = [asyncio.ensure_future(member.run(i * gap_s)) for i, member in enumerate(self._members)]
        rounds = [asyncio.ensure_future(each) for each in (self._beat(), self._look(), self._lag(), self._report())]
        try:
            await self._until_the_end()
            for each in rounds:
                if each.done():
                    each.result()
        finally:
            for each in rounds:
                each.cancel()
            for member in self._members:
                member.stop()
            await asyncio.wait(lives, timeout=_END_WITHIN_S)
            for each in lives:
                each.cancel()
            await asyncio.gather(*lives, *rounds, return_exceptions=True)

    async def _until_the_end(self) -> None:
        try:
            async with asyncio.timeout(self._plan.spread_s):
                await self._ending.wait()
        except TimeoutError:
            self._figures.steady()
        try:
            async with asyncio.timeout(self._plan.seconds - self._plan.spread_s):
                await self._ending.wait()
        except TimeoutError:
            return

    async def _beat(self) -> None:
        """Publish the telemetry of all robots, evenly distributed over each period.

        Who comes more than a period late has missed it; what was missed is not made up for.
        """
        count = len(self._members)
        step_s = 1 / (self._plan.rate_hz * count)
        began_s, number, at_once = time.monotonic(), 0, 0
        while True:
            wait_s = began_s + number * step_s - time.monotonic()
            if wait_s > 0:
                await asyncio.sleep(wait_s)
                at_once = 0
                continue
            behind = int(-wait_s / step_s)
            if behind > count:
                self._figures.counts.missed += sum(
                    self._members[(number + i) % count].up for i in range(behind % count)
                )
                self._figures.counts.missed += behind // count * sum(member.up for member in self._members)
                number += behind
            self._members[number % count].tick(time.monotonic())
            number, at_once = number + 1, at_once + 1
            if at_once >= _AT_ONCE:
                at_once = 0
                await asyncio.sleep(0)

    async def _look(self) -> None:
        """Keep all connections alive."""
        while True:
            for first in range(0, len(self._members), _AT_ONCE):
                for member in self._members[first : first + _AT_ONCE]:
                    member.look()
                await asyncio.sleep(_LOOK_EVERY_S * _AT_ONCE / max(len(self._members), _AT_ONCE))

    async def _lag(self) -> None:
        """Measure the delay of the event loop."""
        while True:
            began_s = time.monotonic()
            await asyncio.sleep(_LAG_EVERY_S)
            self._figures.lag_ms.append((time.monotonic() - began_s - _LAG_EVERY_S) * 1000)

    async def _report(self) -> None:
        while True:
            await asyncio.sleep(self._plan.every_s)
            _tell(self._figures.line(_memory_bytes() - self._before_bytes))


def _tell(text: str) -> None:
    print(text, flush=True)  # noqa: T201 (a terminal program prints)


def _write(plan: LoadOptions, found: dict[str, Any]) -> None:
    text = msgspec.json.encode(found).decode()
    _tell(text)
    if plan.json is not None:
        plan.json.write_text(text + "\n", encoding="utf-8")


def _allow_files(wanted: int) -> None:
    """Raise the limit of open files for the required sockets.

    Raises:
        LoadTestError: The system limit is too low.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft >= wanted:
        return
    if hard != resource.RLIM_INFINITY and hard < wanted:
        raise LoadTestError(f"this system lets a process open {hard} files, {wanted} are needed: see `ulimit -Hn`")
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _memory_bytes() -> int:
    """Current memory of the process [bytes], or its maximum if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return pages * resource.getpagesize()

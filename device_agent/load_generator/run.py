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
from device_agent.load_generator.connection import ProtocolVersion
from device_agent.load_generator.enrollment import Enrollment, Keys
from device_agent.load_generator.kinematic_arm import ArmType, robot_type
from device_agent.load_generator.metrics import Metrics
from device_agent.load_generator.options import LoadOptions, LoadTestError
from device_agent.ports.clock import CloudClock

_THREADS = 8
"""Threads for blocking calls: HTTP and connection setup."""
_SPARE_FILES = 64
_BATCH = 32
"""Number of robots that publish before the event loop handles received data."""
_LAG_PERIOD_S = 0.05
_POLL_PERIOD_S = 1.0
_STOP_TIMEOUT_S = 10.0


def run(options: LoadOptions) -> int:
    """Run the load test. Returns the exit code: 0 if all agents were connected at the same time.

    Raises:
        LoadTestError: The load test cannot start.
        CloudError: The server rejects an agent.
        OSError: The server cannot be reached, or a file cannot be written.
    """
    _allow_files(options.count + _SPARE_FILES)
    baseline_bytes = _memory_bytes()
    clock = CloudClock()
    arm_robot_type = robot_type(options.type, options.joints, options.rate_hz)
    enrollment = Enrollment(options, arm_robot_type, clock)
    with ThreadPoolExecutor(_THREADS, "load-test") as pool:
        keys = Keys(options.home).first(options.count)
        pairings = enrollment.enroll_all(keys, pool, _print)
        metrics = Metrics(options.count)

        async def run_agents() -> None:
            arm_type, version = ArmType(arm_robot_type), ProtocolVersion()
            agents = [
                LoadAgent(
                    options,
                    enrollment.client(key),
                    pairing,
                    arm_type,
                    clock=clock,
                    version=version,
                    metrics=metrics,
                    pool=pool,
                    identity=key,
                )
                for key, pairing in zip(keys, pairings, strict=True)
            ]
            await _LoadTest(options, agents, metrics, baseline_bytes).run()

        asyncio.run(run_agents())
    results = {
        "rate_hz": options.rate_hz,
        "joints": options.joints,
        **metrics.summary(_memory_bytes() - baseline_bytes),
    }
    _write(options, results)
    return 0 if metrics.most_connected == options.count else 1


class _LoadTest:
    """Runs all agents in one event loop."""

    def __init__(
        self, options: LoadOptions, agents: Sequence[LoadAgent], metrics: Metrics, baseline_bytes: int
    ) -> None:
        self._options = options
        self._agents = agents
        self._metrics = metrics
        self._baseline_bytes = baseline_bytes
        self._ending = asyncio.Event()

    async def run(self) -> None:
        """Connect, publish telemetry, and stop after the duration."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._ending.set)
        gap_s = self._options.spread_s / len(self._agents)
        runs = [asyncio.ensure_future(agent.run(i * gap_s)) for i, agent in enumerate(self._agents)]
        periodic = [
            asyncio.ensure_future(task)
            for task in (self._publish_telemetry(), self._poll(), self._measure_lag(), self._report())
        ]
        try:
            await self._wait_for_end()
            for task in periodic:
                if task.done():
                    task.result()
        finally:
            for task in periodic:
                task.cancel()
            for agent in self._agents:
                agent.stop()
            await asyncio.wait(runs, timeout=_STOP_TIMEOUT_S)
            for task in runs:
                task.cancel()
            await asyncio.gather(*runs, *periodic, return_exceptions=True)

    async def _wait_for_end(self) -> None:
        try:
            async with asyncio.timeout(self._options.spread_s):
                await self._ending.wait()
        except TimeoutError:
            self._metrics.start_steady()
        try:
            async with asyncio.timeout(self._options.seconds - self._options.spread_s):
                await self._ending.wait()
        except TimeoutError:
            return

    async def _publish_telemetry(self) -> None:
        """Publish the telemetry of all robots, evenly distributed over each period.

        Messages that are more than a period late are counted as missed and not sent.
        """
        count = len(self._agents)
        step_s = 1 / (self._options.rate_hz * count)
        start_s, number, batch = time.monotonic(), 0, 0
        while True:
            wait_s = start_s + number * step_s - time.monotonic()
            if wait_s > 0:
                await asyncio.sleep(wait_s)
                batch = 0
                continue
            behind = int(-wait_s / step_s)
            if behind > count:
                self._metrics.counts.missed += sum(self._agents[(number + i) % count].up for i in range(behind % count))
                self._metrics.counts.missed += behind // count * sum(agent.up for agent in self._agents)
                number += behind
            self._agents[number % count].tick(time.monotonic())
            number, batch = number + 1, batch + 1
            if batch >= _BATCH:
                batch = 0
                await asyncio.sleep(0)

    async def _poll(self) -> None:
        """Poll all connections."""
        while True:
            for first in range(0, len(self._agents), _BATCH):
                for agent in self._agents[first : first + _BATCH]:
                    agent.poll()
                await asyncio.sleep(_POLL_PERIOD_S * _BATCH / max(len(self._agents), _BATCH))

    async def _measure_lag(self) -> None:
        """Measure the delay of the event loop."""
        while True:
            start_s = time.monotonic()
            await asyncio.sleep(_LAG_PERIOD_S)
            self._metrics.lag_ms.append((time.monotonic() - start_s - _LAG_PERIOD_S) * 1000)

    async def _report(self) -> None:
        while True:
            await asyncio.sleep(self._options.every_s)
            _print(self._metrics.line(_memory_bytes() - self._baseline_bytes))


def _print(text: str) -> None:
    print(text, flush=True)  # noqa: T201 (a terminal program prints)


def _write(options: LoadOptions, results: dict[str, Any]) -> None:
    text = msgspec.json.encode(results).decode()
    _print(text)
    if options.json is not None:
        options.json.write_text(text + "\n", encoding="utf-8")


def _allow_files(required: int) -> None:
    """Raise the limit of open files for the required sockets.

    Raises:
        LoadTestError: The system limit is too low.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft >= required:
        return
    if hard != resource.RLIM_INFINITY and hard < required:
        raise LoadTestError(f"this system allows {hard} open files per process, not {required}: see `ulimit -Hn`")
    resource.setrlimit(resource.RLIMIT_NOFILE, (required, hard))


def _memory_bytes() -> int:
    """Current memory of the process [bytes], or its maximum if the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return pages * resource.getpagesize()

"""The worker's timer decides no outcome before agents have repeated what the worker missed."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from function_app.entrypoints.hosts import worker
from function_app.entrypoints.hosts.worker import CATCH_UP_S, SWEEP_EVERY_S
from function_app.ports.tables import StoreError
from tests.fakes.clock import MemoryClock
from tests.fakes.event_loop import VirtualTimeLoop


def test_after_a_start_or_a_suspension_the_timer_waits_for_agents() -> None:
    loop = VirtualTimeLoop(MemoryClock())
    runs: list[tuple[float, bool]] = []

    async def run_due_jobs(*, current: bool) -> None:
        runs.append((loop.time(), current))

    functions: Any = SimpleNamespace(scheduler=SimpleNamespace(run_due_jobs=run_due_jobs))

    async def scenario() -> float:
        sweep = asyncio.create_task(worker._sweep(functions))
        await asyncio.sleep(20)
        loop._skip(100.0)  # the process is suspended
        resumed_s = loop.time()
        await asyncio.sleep(20)
        sweep.cancel()
        return resumed_s

    resumed_s = loop.complete(scenario())
    loop.end()
    behind = [at_s for at_s, current in runs if not current]
    assert behind == [at_s for at_s, _ in runs if at_s < CATCH_UP_S or resumed_s <= at_s < behind[-1] + SWEEP_EVERY_S]
    assert CATCH_UP_S - SWEEP_EVERY_S <= behind[-1] - resumed_s <= CATCH_UP_S + SWEEP_EVERY_S
    assert [current for _, current in runs][-1]


def test_unavailable_tables_are_one_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    loop = VirtualTimeLoop(MemoryClock())

    async def unavailable(**_: bool) -> None:
        raise StoreError("the tables were deleted")

    async def present() -> None:
        """MuJoCo is installed."""

    functions: Any = SimpleNamespace(
        scheduler=SimpleNamespace(run_due_jobs=unavailable),
        model_checks=SimpleNamespace(require=present, run=unavailable),
    )

    async def scenario() -> None:
        tasks = [asyncio.create_task(each) for each in (worker._sweep(functions), worker._check_models(functions))]
        await asyncio.sleep(2)
        for task in tasks:
            task.cancel()

    loop.complete(scenario())
    loop.end()
    assert {record.getMessage() for record in caplog.records} == {
        "timer: the tables were deleted",
        "model checks: the tables were deleted",
    }
    assert {record.exc_info for record in caplog.records} == {None}


def test_the_worker_survives_unavailable_tables_while_it_looks_for_the_compiler() -> None:
    loop = VirtualTimeLoop(MemoryClock())
    calls: list[str] = []

    async def require() -> None:
        calls.append("require")
        if calls.count("require") < 3:
            raise StoreError("the tables were replaced")

    async def run() -> bool:
        calls.append("run")
        return False

    functions: Any = SimpleNamespace(model_checks=SimpleNamespace(require=require, run=run))

    async def scenario() -> bool:
        checks = asyncio.create_task(worker._check_models(functions))
        await asyncio.sleep(30)
        ended = checks.done()
        checks.cancel()
        return ended

    assert not loop.complete(scenario()), "the worker ends with its first task"
    loop.end()
    assert calls[:4] == ["require"] * 3 + ["run"]

"""The local worker: stores messages from the broker and runs timers. Several workers may run concurrently."""

import asyncio
import logging
import signal
from collections.abc import Sequence

import function_app
from function_app.bootstrap import Functions
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry
from function_app.ports.model_compiler import CompilerMissingError
from function_app.ports.tables import StoreError
from function_app.services.maintenance.heartbeats import HEALTH_TOPICS, JOBS

SWEEP_EVERY_S = 1.0
SWEEP_TIMEOUT_S = 120.0
"""A run that waits longer is repeated: all jobs are idempotent."""
CHECK_EVERY_S = 0.2
REQUIRE_AGAIN_S = 5.0
"""Pause before the compiler is looked for again [s], which starts a process."""
CATCH_UP_S = 10.0
"""After a start or a suspension, agents need this time to repeat what the worker has missed [s]."""
_log = logging.getLogger(__name__)


async def work(functions: Functions) -> None:
    """Run until SIGINT or SIGTERM.

    Raises:
        StoreError: The tables are not available at the start.
    """
    stopping = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopping.set)
    await functions.health.require_tables()

    async def handle(topic: str, payload: bytes) -> None:
        await ingest(functions, topic, payload)
        if not topic.startswith(HEALTH_TOPICS):
            await functions.confirmations.publish([(topic, payload)])

    async def handle_telemetry(messages: Sequence[tuple[str, bytes]]) -> None:
        await ingest_telemetry(functions, messages)
        await functions.confirmations.publish(messages)

    function_app.run_for_long()
    functions.heartbeats.expect(JOBS)
    tasks = [
        asyncio.create_task(functions.heartbeats.run()),
        asyncio.create_task(functions.feed.run(handle)),
        asyncio.create_task(functions.telemetry.run(handle_telemetry)),
        asyncio.create_task(functions.late.run(handle_telemetry)),
        asyncio.create_task(_sweep(functions)),
        asyncio.create_task(_check_models(functions)),
    ]
    waiting = asyncio.create_task(stopping.wait())
    done, _ = await asyncio.wait([*tasks, waiting], return_when=asyncio.FIRST_COMPLETED)
    for task in (*tasks, waiting):
        task.cancel()
    await asyncio.gather(*tasks, waiting, return_exceptions=True)
    for task in done - {waiting}:
        task.result()


async def check_models(functions: Functions, *, drain: bool) -> None:
    """Check uploaded models, until none is left (``drain``) or without end.

    Raises:
        CompilerMissingError: MuJoCo is not installed, or cannot be confined.
        StoreError: The tables are not available at the start.
    """
    await functions.model_checks.require()
    while True:
        try:
            busy = await functions.model_checks.run()
        except CompilerMissingError:
            raise
        except StoreError as error:
            _log.warning("model checks: %s", error)
            busy = False
        except Exception:  # noqa: BLE001 (the checker survives an invalid upload, which is rejected after a few attempts)
            _log.exception("model checks")
            busy = False
        if drain and not busy:
            return
        await asyncio.sleep(0 if busy else CHECK_EVERY_S)


async def _check_models(functions: Functions) -> None:
    """Check models if MuJoCo is installed and confined; another worker runs the other tasks."""
    while True:
        try:
            await check_models(functions, drain=False)
        except CompilerMissingError as error:
            _log.warning("this worker does not check uploaded models: %s", error)
            await asyncio.Event().wait()
        except StoreError as error:
            _log.warning("model checks: %s", error)
            await asyncio.sleep(REQUIRE_AGAIN_S)


async def _sweep(functions: Functions) -> None:
    loop = asyncio.get_running_loop()
    ran_s = current_s = float("-inf")
    while True:
        if loop.time() - ran_s > CATCH_UP_S / 2:
            current_s = loop.time() + CATCH_UP_S
        ran_s = loop.time()
        try:
            async with asyncio.timeout(SWEEP_TIMEOUT_S):
                await functions.scheduler.run_due_jobs(current=ran_s >= current_s)
            functions.heartbeats.ran(JOBS)
        except StoreError as error:
            _log.warning("timer: %s", error)
        except Exception:  # noqa: BLE001 (the timer continues after a failed run)
            _log.exception("timer")
        await asyncio.sleep(SWEEP_EVERY_S)

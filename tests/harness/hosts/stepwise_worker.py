"""``python -m tests.harness.hosts.stepwise_worker``: executes one task of the worker for each input line.

Input: ``{"do": "sweep"}`` or ``{"do": "ingest", "topic": …, "payload": base64}``. Output: ``""`` or the error.
"""

import asyncio
import base64
import json
import sys
from typing import Any

from function_app import bootstrap, settings
from function_app.bootstrap import Functions
from function_app.entrypoints.ingest.router import ingest


async def main() -> None:
    functions = bootstrap.build(settings.read())
    while line := await asyncio.to_thread(sys.stdin.readline):
        try:
            await _do(functions, json.loads(line))
        except Exception as error:  # noqa: BLE001 (returned to the test)
            answer = f"{type(error).__name__}: {error}"
        else:
            answer = ""
        print(json.dumps(answer), flush=True)  # noqa: T201
    await functions.close()


async def _do(functions: Functions, step: dict[str, Any]) -> None:
    if step["do"] == "sweep":
        await functions.scheduler.run_due_jobs()
    else:
        await ingest(functions, step["topic"], base64.b64decode(step["payload"]))


if __name__ == "__main__":
    asyncio.run(main())

"""``python -m benchmarks.faults.supervisor``: ``make up`` with programs into which faults can be injected."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from infra.local import __main__ as local
from infra.local import settings, supervisor

_WATCHDOG_S = "0.3"


class _Process(supervisor.SupervisedProcess):
    """The same program under the launcher; the agent reports its control periods."""

    def __init__(self, name: str, arguments: Sequence[str], environment: dict[str, str], logs: Path) -> None:
        module, *options = arguments[1:]
        if name == "agent":
            port = str(settings.read(os.environ).mqtt_port)
            module, options = "benchmarks.faults.agent", [port, _WATCHDOG_S, *options[1:]]
        super().__init__(name, ["-m", "benchmarks.faults.launcher", module, *options], environment, logs)


if __name__ == "__main__":
    setattr(local, supervisor.SupervisedProcess.__name__, _Process)
    sys.exit(local.main())

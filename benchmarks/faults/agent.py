"""The agent with a report of each control period.

``python -m benchmarks.faults.agent MQTT_PORT WATCHDOG_S …`` sends a datagram per control period (``recorder.Period``)
and per started action to ``$TELESCOPE_HOME/recorder.socket``. The product contains no such code.
"""

import contextlib
import os
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

from device_agent.protocol import Command
from device_agent.runtime.actions.executor import ActionExecutor
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.controller import Controller
from tests.faults import agent


def main(*arguments: str) -> int:
    """Runs the agent until it is terminated."""
    _report_periods(str(Path(os.environ["TELESCOPE_HOME"]) / "recorder.socket"))
    return agent.main(*arguments)


def _report_periods(path: str) -> None:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    connection.setblocking(False)
    update, start = Controller.update, ActionExecutor.start
    before: dict[str, list[float]] = {}
    names: dict[int, str] = {}

    def send(text: str) -> None:
        with contextlib.suppress(OSError):  # without a receiver or with a slow one, the control loop must not wait
            connection.sendto(text.encode(), path)

    def updated(controller: Controller, *args: Any, **kwargs: Any) -> ControlOutput:
        tick = update(controller, *args, **kwargs)
        thread = threading.current_thread().name
        if thread.endswith("-loop"):  # a thread that delivers a message may also start a period
            names[id(controller)] = thread.removesuffix("-loop")
        name = names.get(id(controller), "")
        moved = max(
            map(abs, (new - old for new, old in zip(tick.position_rad, before.get(name, []), strict=False))),
            default=0.0,
        )
        before[name] = tick.position_rad
        send(
            f"period {name} {time.monotonic() * 1000:.3f} {tick.mode} {moved:.9f} {tick.epoch} {tick.setpoint_sequence}"
        )
        return tick

    def started(executor: ActionExecutor, command: Command, request: Any) -> None:
        send(f"started {command.device} {command.id}")
        start(executor, command, request)

    Controller.update = updated  # type: ignore[method-assign,assignment]
    ActionExecutor.start = started  # type: ignore[method-assign,assignment]


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

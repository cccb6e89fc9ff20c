"""The agent with a report of each control period and an adjustable wall clock.

``python -m benchmarks.faults.agent MQTT_PORT WATCHDOG_S …`` sends a datagram per control period (``recorder.Period``)
and per started action to ``$TELESCOPE_HOME/recorder.socket``. SIGUSR1 and SIGUSR2 move its wall clock forward and back
by one hour. The product contains no such code.
"""

import contextlib
import os
import signal
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

JUMP_S = 3600.0


def main(*arguments: str) -> int:
    """Runs the agent until it is terminated."""
    _report_periods(str(Path(os.environ["TELESCOPE_HOME"]) / "recorder.socket"))
    _set_clock_by_signals()
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


def _set_clock_by_signals() -> None:
    offset_s = 0.0
    seconds, nanoseconds = time.time, time.time_ns

    def jump(number: int, _frame: object) -> None:
        nonlocal offset_s
        offset_s += JUMP_S if number == signal.SIGUSR1 else -JUMP_S

    time.time = lambda: seconds() + offset_s
    time.time_ns = lambda: nanoseconds() + round(offset_s * 1e9)
    signal.signal(signal.SIGUSR1, jump)
    signal.signal(signal.SIGUSR2, jump)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

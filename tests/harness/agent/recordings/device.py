"""A recorded device without a control loop and a recorder: the test runs its periods."""

import time
from typing import Any

from device_agent.ports.driver import Observation, Twist
from device_agent.protocol import Measurements, Mode
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.control.command_arbiter import ControlOutput
from device_agent.runtime.control.control_loop import Period
from device_agent.runtime.recording.device_recording import DeviceRecording
from device_agent.runtime.recording.format import ControlRow
from device_agent.runtime.recording.messages import Batch, RecorderStatus
from tests.fakes.drivers import robot_type

MEASURED = Measurements(tick_ms=1, at_ms=2, sequence=3, values={"temperature_c": 20.0})


class Recorded:
    """A recorded device, and its control loop."""

    def __init__(self) -> None:
        self.events = list[EventRecord]()
        self.action_epoch = 0
        self.now_s = time.monotonic()
        self.device = DeviceRecording(
            "agent",
            "arm",
            robot_type(),
            simulated=True,
            newest_epoch=lambda: self.action_epoch,
            holder=lambda epoch: f"holder of {epoch}",
            record=self.events.append,
        )

    def run(
        self, periods: int = 1, *, mode: Mode = Mode.IDLE, epoch: int = 7, moving: bool = False, **more: Any
    ) -> None:
        for _ in range(periods):
            output = ControlOutput([0.1, 0.2], mode, epoch, 5, 0.0, 12.0, ("elbow: range",), Twist(1, 2, 3), **more)
            observation = Observation((0.0, 0.1), (0.0, 0.0), (0.0, 0.0), ())
            self.device.record_period(Period(self.now_s, observation, output, (0.1, 0.15), moving))
            self.now_s += 0.008

    def take(self, status: RecorderStatus | None = None) -> list[Batch]:
        batches = []
        for batch in self.device.take():
            batches.append(batch)
            self.device.confirm(status or RecorderStatus())
        return batches

    def rows(self) -> list[ControlRow]:
        return [row for batch in self.take() for row in batch.rows]

    def kinds(self) -> list[EventKind]:
        return [event.kind for event in self.events]

"""A recorded device with a fake arm in a process that a test kills; it has a lease and moves slowly.

``python -m tests.harness.agent.recordings.agent FOLDER SEGMENT_S`` prints the id of the recorder process once the
recording is active, and then number and monotonic clock [ns] of each control period.
"""

import math
import os
import sys
import time
from pathlib import Path

from device_agent.protocol import GrantLease
from device_agent.runtime.control.control_loop import Period
from device_agent.runtime.recording.recorder import Recorder
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.agent.recordings.segments import limits

EPOCH = 3


def main() -> None:
    folder, segment_s = Path(sys.argv[1]), float(sys.argv[2])
    recorder = Recorder(limits(folder / "recordings", segment_s=segment_s), owner="s/ann")
    agent = DeviceHarness(folder, recorder=recorder)
    recording = agent.device._recording
    assert recording is not None
    record = agent.device._loop._record  # type: ignore[union-attr]
    assert record is not None

    started: list[bool] = []

    def report(period: Period) -> None:
        number = recording._sequence
        record(period)
        if started:
            os.write(1, f"{number} {round(period.now_s * 1e9)}\n".encode())

    agent.device._loop._record = report  # type: ignore[union-attr]
    recorder.start()
    agent.start()
    agent.done(GrantLease(holder="ann", lease_ms=600_000), epoch=EPOCH)
    eventually(lambda: recording.active)
    started.append(True)
    os.write(1, f"recorder {recorder._process.pid}\n".encode())
    sequence = 0
    while True:
        sequence += 1
        # So slow that the watchdog does not end the lease if this machine is busy.
        agent.setpoint(EPOCH, sequence, elbow=0.1 * math.sin(sequence / 400))
        time.sleep(0.025)


if __name__ == "__main__":
    main()

"""The ground truth of a world as lines of JSON, for tests that cannot reach into the process."""

import json
import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from device_agent.drivers.mujoco.snapshot import Floats, Snapshot
from device_agent.ports.driver import DriverError

log = logging.getLogger(__name__)

PERIOD_S = 0.01


class Trace:
    """Appends to a file: at each start a line that names the columns, then 100 lines per second of simulated time.

    The first line has ``joints`` and ``actuators``. Each other has ``tick_ms`` (monotonic clock), ``at_ms`` (wall
    clock), ``time_s``, ``lag_ms``, ``qpos`` and ``qvel`` by joint, and by actuator ``target`` (the newest command) and
    ``ctrl`` (what the actuator follows). Writing is part of stepping: slow disks show as lag, full ones end the trace.
    """

    def __init__(self, path: Path, model: Any, joints: Sequence[str]) -> None:
        """Open the file and write the first line.

        Raises:
            DriverError: The file cannot be written.
        """
        self._velocities = [int(model.jnt_dofadr[model.joint(name).id]) for name in joints]
        self._next_s = -np.inf
        columns = {"joints": list(joints), "actuators": [model.actuator(index).name for index in range(model.nu)]}
        try:
            self._file = path.open("a", encoding="utf-8", buffering=1)
        except OSError as error:
            raise DriverError(f"cannot write the trace file: {error}") from error
        try:
            self._file.write(json.dumps(columns) + "\n")
        except OSError as error:
            self.close()
            raise DriverError(f"cannot write the trace file: {error}") from error

    def write(self, snapshot: Snapshot, target: Floats) -> None:
        """Add a line if one is due."""
        if snapshot.time_s < self._next_s or self._file.closed:
            return
        self._next_s = max(self._next_s + PERIOD_S, snapshot.time_s + PERIOD_S / 2)
        row = {
            "tick_ms": round(snapshot.taken_s * 1000, 3),
            "at_ms": round(time.time() * 1000, 3),
            "time_s": round(snapshot.time_s, 6),
            "lag_ms": round(snapshot.lag_ms, 3),
            "qpos": [round(value, 9) for value in snapshot.position_rad.values()],
            "qvel": np.round(snapshot.qvel[self._velocities], 9).tolist(),
            "target": np.round(target, 9).tolist(),
            "ctrl": np.round(snapshot.ctrl, 9).tolist(),
        }
        try:
            self._file.write(json.dumps(row) + "\n")
        except OSError as error:
            log.warning("the trace ends here: %s", error)
            self.close()

    def close(self) -> None:
        """End it. May be called twice."""
        with suppress(OSError):
            self._file.close()

"""Ground truth of a world as JSON lines, for tests outside the process."""

import json
import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from device_agent.ports.driver import DriverError
from device_agent.simulation.snapshot import Floats, Snapshot

log = logging.getLogger(__name__)

PERIOD_S = 0.01


class Trace:
    """Appends to a file: a header line per start, then 100 lines per second of simulated time.

    The header has ``joints`` and ``actuators``. Each other line has ``tick_ms`` (monotonic clock), ``at_ms`` (wall
    clock), ``time_s``, ``lag_ms``, ``qpos`` and ``qvel`` by joint, and by actuator ``target`` (the newest command) and
    ``ctrl`` (the interpolated control). Writing is part of stepping: slow disks appear as lag, full ones end the trace.
    """

    def __init__(self, path: Path, model: Any, joints: Sequence[str], *, prefix: str = "") -> None:
        """Open the file and write the header.

        Args:
            path: The file.
            model: ``MjModel``.
            joints: Names of all hinges and slides.
            prefix: Write only joints and actuators with this prefix, without the prefix.

        Raises:
            DriverError: The file cannot be written.
        """
        own = [name for name in joints if name.startswith(prefix)]
        actuators = [model.actuator(index).name for index in range(model.nu)]
        self._positions = [int(model.jnt_qposadr[model.joint(name).id]) for name in own]
        self._velocities = [int(model.jnt_dofadr[model.joint(name).id]) for name in own]
        self._actuators = [index for index, name in enumerate(actuators) if name.startswith(prefix)]
        self._next_s = -np.inf
        columns = {
            "joints": [name.removeprefix(prefix) for name in own],
            "actuators": [actuators[index].removeprefix(prefix) for index in self._actuators],
        }
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
        """Append a line if one is due."""
        if snapshot.time_s < self._next_s or self._file.closed:
            return
        self._next_s = max(self._next_s + PERIOD_S, snapshot.time_s + PERIOD_S / 2)
        row = {
            "tick_ms": round(snapshot.taken_s * 1000, 3),
            "at_ms": round(time.time() * 1000, 3),
            "time_s": round(snapshot.time_s, 6),
            "lag_ms": round(snapshot.lag_ms, 3),
            "qpos": np.round(snapshot.qpos[self._positions], 9).tolist(),
            "qvel": np.round(snapshot.qvel[self._velocities], 9).tolist(),
            "target": np.round(target[self._actuators], 9).tolist(),
            "ctrl": np.round(snapshot.ctrl[self._actuators], 9).tolist(),
        }
        try:
            self._file.write(json.dumps(row) + "\n")
        except OSError as error:
            log.warning("cannot write the trace file; tracing stopped: %s", error)
            self.close()

    def close(self) -> None:
        """Close the file. May be called twice."""
        with suppress(OSError):
            self._file.close()

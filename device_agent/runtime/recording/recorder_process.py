"""Client of the recorder process: encoding and writing hold the interpreter lock, which would delay control loops.

The process starts with the first batch and ends when the connection to the agent closes.
"""

import os
import signal
import subprocess
import sys
import time
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec

from device_agent.runtime.recording.messages import Batch, RecorderStatus, RecordingLimits

_ROOT = Path(__file__).resolve().parents[3]
_MODULE = "device_agent.runtime.recording.recorder_worker"
_POLL_S = 0.05
"""Interval at which the end of the process is noticed [s]."""
RESPONSE_S = 20.0
"""Time for start-up and a response on a busy machine [s]."""


class RecorderLostError(Exception):
    """The recorder process has ended or does not respond; the text states why."""


class RecorderProcess:
    """The recorder process. One thread calls ``exchange``; any thread may call ``kill``."""

    def __init__(self, limits: RecordingLimits) -> None:
        self._limits = limits
        self._process: subprocess.Popen[bytes] | None = None
        self._link: Connection | None = None

    @property
    def pid(self) -> int:
        """Id of the process; 0 if none runs."""
        process = self._process
        return 0 if process is None else process.pid

    def exchange(self, batch: Batch, *, within_s: float = RESPONSE_S) -> RecorderStatus:
        """Send a batch, and wait for the response. Starts the process unless it runs.

        Raises:
            RecorderLostError: The process cannot be started, has ended, or does not respond within ``within_s`` [s].
        """
        try:
            link, process = self._start()
            link.send_bytes(msgspec.msgpack.encode(batch))
            self._await(link, process, time.monotonic() + within_s)
            return msgspec.msgpack.decode(link.recv_bytes(), type=RecorderStatus)
        except (EOFError, OSError) as error:
            reason = _exit_reason(self.kill())
            raise RecorderLostError(f"the recorder process has ended ({reason})") from error

    def _await(self, link: Connection, process: subprocess.Popen[bytes], until_s: float) -> None:
        """Wait for a response. A child of the process may keep the connection open after its end."""
        while not link.poll(_POLL_S):
            if process.poll() is not None:
                raise EOFError
            if time.monotonic() > until_s:
                self.kill()
                raise RecorderLostError("the recorder process does not respond")

    def _start(self) -> tuple[Connection, subprocess.Popen[bytes]]:
        if self._link is not None and self._process is not None:
            return self._link, self._process
        own_end, child_end = Pipe()
        with child_end:
            try:
                process = subprocess.Popen(  # noqa: S603 (the agent's own module)
                    [sys.executable, "-c", f"from {_MODULE} import main; main()"],
                    stdin=child_end.fileno(),
                    stdout=subprocess.DEVNULL,
                    env=os.environ | {"PYTHONPATH": str(_ROOT)},
                    start_new_session=True,
                )
            except OSError as error:
                own_end.close()
                raise RecorderLostError(f"the recorder process does not start: {error}") from error
        self._link, self._process = own_end, process
        own_end.send_bytes(msgspec.msgpack.encode(self._limits))
        return own_end, process

    def kill(self) -> int:
        """Kill the process if it runs; returns its exit code."""
        process, link, self._process, self._link = self._process, self._link, None, None
        code = 0
        if process is not None:
            process.kill()
            code = process.wait()
        if link is not None:
            link.close()
        return code

    def close(self, *, within_s: float) -> None:
        """Let the process seal all segments and end; kill it if that takes longer than ``within_s`` [s]."""
        if self._process is None:
            return
        try:
            self.exchange(Batch(closing=True), within_s=within_s)
            self._process.wait(within_s)
        except (RecorderLostError, subprocess.TimeoutExpired):
            pass
        self.kill()


def _exit_reason(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"code {code}; see the agent's log"

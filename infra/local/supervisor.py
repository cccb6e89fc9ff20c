"""Supervised child processes: start, monitor, restart and stop."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from infra import programs

_STOP_TIMEOUT_S = 8.0
_STABLE_S = 10.0
_MAX_RESTARTS = 5
_MAX_LOG_BYTES = 10_000_000


class StartError(Exception):
    """A program could not be started, or exits repeatedly; the message is its last output line."""


class SupervisedProcess:
    """One program of the product.

    Args:
        name: For messages and the log file.
        arguments: Arguments of the Python interpreter.
        environment: Its environment.
        logs: Folder of its log.
    """

    def __init__(self, name: str, arguments: Sequence[str], environment: dict[str, str], logs: Path) -> None:
        self.name = name
        self.log = logs / f"{name}.log"
        self._command = [sys.executable, *arguments]
        self._environment = environment
        self._process: subprocess.Popen[bytes] | None = None
        self._started_s = 0.0
        self._restarts = 0
        self._log_start = 0

    def start(self) -> None:
        """Start the process; its output goes to its log."""
        with self.log.open("ab") as log:
            self._log_start = log.tell()
            self._process = subprocess.Popen(  # noqa: S603 (fixed commands)
                self._command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C only reaches this process, which stops the others in order
                preexec_fn=lambda: programs.signal_with_parent(signal.SIGTERM),  # noqa: PLW1509 (one thread here)
            )
        self._started_s = time.monotonic()

    def wait_for_line(self, prefix: str, timeout_s: float) -> str:
        """Wait for an output line with this prefix.

        Returns:
            The line.

        Raises:
            StartError: The process exited, or the line did not appear in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            exited = self.exited
            for line in self.output_lines():
                if line.startswith(prefix):
                    return line
            if exited:
                raise StartError(self.last_line())
            time.sleep(0.05)
        raise StartError(f"{self.name} did not start within {timeout_s:.0f} s; see {self.log}")

    def limit_log(self) -> None:
        """Move the lines of a long log to ``NAME.log.1``, and continue with an empty one."""
        if self.log.stat().st_size > _MAX_LOG_BYTES:
            shutil.copyfile(self.log, self.log.with_suffix(".log.1"))
            os.truncate(self.log, 0)  # the process appends to the open file
            self._log_start = 0

    @property
    def exited(self) -> bool:
        """Whether the process has exited."""
        return self._process is None or self._process.poll() is not None

    def restart(self) -> None:
        """Restart the process after it exited.

        Raises:
            StartError: It exits repeatedly.
        """
        if time.monotonic() - self._started_s > _STABLE_S:
            self._restarts = 0
        self._restarts += 1
        if self._restarts > _MAX_RESTARTS:
            raise StartError(f"{self.name} exits repeatedly: {self.last_line()}")
        self.start()

    def stop(self) -> None:
        """Stop the process: SIGTERM, then SIGKILL after a timeout."""
        if self._process is None:
            return
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def output_lines(self) -> list[str]:
        """Output lines since the last start."""
        with self.log.open("rb") as log:
            log.seek(self._log_start)
            return log.read().decode(errors="replace").splitlines()

    def last_line(self) -> str:
        """The last output line, or a reference to the log."""
        lines = [line for line in self.output_lines() if line.strip()]
        return lines[-1] if lines else f"{self.name} exited without output; see {self.log}"

"""Child processes: started, watched, restarted, and ended in order."""

import ctypes
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

_STOP_WITHIN_S = 8.0
_STEADY_S = 10.0
_MOST_RESTARTS = 5
_PR_SET_PDEATHSIG = 1


class StartError(Exception):
    """A program could not be started or kept running; the text is its own last word."""


class Child:
    """One program of the product.

    Args:
        name: For people and for the log file's name.
        arguments: Of the Python interpreter.
        environment: What it sees.
        logs: Folder for its log.
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
        """Start it; its output goes to its log."""
        with self.log.open("ab") as log:
            self._log_start = log.tell()
            self._process = subprocess.Popen(  # noqa: S603 (our own programs)
                self._command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches us alone, and we end the others in order
                preexec_fn=_end_with_parent if sys.platform == "linux" else None,  # noqa: PLW1509 (one thread here)
            )
        self._started_s = time.monotonic()

    def await_line(self, beginning: str, within_s: float) -> str:
        """Wait until its output has a line that starts so.

        Returns:
            That line.

        Raises:
            StartError: It ended, or said nothing of the kind in time.
        """
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            ended = self.ended
            for line in self.said():
                if line.startswith(beginning):
                    return line
            if ended:
                raise StartError(self.last_word())
            time.sleep(0.05)
        raise StartError(f"{self.name} did not start within {within_s:.0f} s; its log: {self.log}")

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        return self._process is None or self._process.poll() is not None

    def restart(self) -> None:
        """Start it again after it ended by itself.

        Raises:
            StartError: It keeps ending.
        """
        if time.monotonic() - self._started_s > _STEADY_S:
            self._restarts = 0
        self._restarts += 1
        if self._restarts > _MOST_RESTARTS:
            raise StartError(f"{self.name} keeps ending: {self.last_word()}")
        self.start()

    def stop(self) -> None:
        """End it: asked first, made to after some seconds."""
        if self._process is None:
            return
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(_STOP_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def said(self) -> list[str]:
        """The lines it has printed since it was last started."""
        with self.log.open("rb") as log:
            log.seek(self._log_start)
            return log.read().decode(errors="replace").splitlines()

    def last_word(self) -> str:
        """Its last line, or where to look."""
        lines = [line for line in self.said() if line.strip()]
        return lines[-1] if lines else f"{self.name} ended without a word; its log: {self.log}"


def _end_with_parent() -> None:
    """Linux: when whoever started us dies, we are asked to end too."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

"""Trial of a new release: nothing moves until it has proved that it works. Without proof the launcher ends its use.

The launcher (``launch.sh``) starts a release on trial with ``TELESCOPE_TRIAL``: id, whether a link is required, and
the time limit. The result is in the agent's folder, because only that folder is writable for the agent.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from device_agent.config import private_file

RESULT_FILE = "release-trial"
PASSED, FAILED = "passed", "failed"
SUSPENDED = "a new release of the agent is being checked; take control again in a minute"
HEALTHY_S = 5.0
"""Time for which every essential thread must run without a failure [s]; a hang is noticed within 1 s."""
EXIT_FAILED = 70
_EXIT_S = 10.0
"""Time for an orderly end after a failed trial [s]."""


class Trial:
    """The trial of the running release.

    Args:
        folder: The agent's folder.
        trial: Id of the trial.
        needs_link: Whether the link must come up, because the release before had one.
        timeout_s: Time from the start of the program to the proof [s].
    """

    def __init__(self, folder: Path, trial: str, *, needs_link: bool, timeout_s: float) -> None:
        self._folder = folder
        self._trial = trial
        self._needs_link = needs_link
        self._timeout_s = timeout_s
        self._healthy_since_s: float | None = None
        self._missing = "it did not start its devices"
        self._lock = threading.Lock()
        self.over = False

    @classmethod
    def of(cls, folder: Path, environment: Mapping[str, str]) -> Self | None:
        """The trial that the launcher announces, or ``None``."""
        with contextlib.suppress(ValueError):
            trial, needs_link, timeout_s = environment.get("TELESCOPE_TRIAL", "").split()
            return cls(folder, trial, needs_link=needs_link == "1", timeout_s=float(timeout_s))
        return None

    def start(self) -> None:
        """Start the time limit."""
        timer = threading.Timer(self._timeout_s, self._expire)
        timer.daemon = True
        timer.start()

    def check(self, *, healthy: bool, linked: bool, now_s: float) -> bool:
        """Check once in each supervision period. Returns True when the trial has just been passed."""
        if self.over:
            return False
        self._missing = "its threads fail" if not healthy else "it has no link to the cloud, as the release before had"
        if not healthy or (self._needs_link and not linked):
            self._healthy_since_s = None
            return False
        self._healthy_since_s = self._healthy_since_s or now_s
        self._missing = "its threads fail"
        return now_s - self._healthy_since_s >= HEALTHY_S and self.finish(PASSED)

    def finish(self, result: str, reason: str = "") -> bool:
        """Write the result. Returns False if there is one already."""
        with self._lock:
            if self.over:
                return False
            private_file.write(self._folder / RESULT_FILE, f"{self._trial} {result} {reason}\n".encode())
            self.over = True
            return True

    def _expire(self) -> None:
        reason = f"{self._missing} within {self._timeout_s:g} s"
        if self.finish(FAILED, reason):
            print(f"telescope agent: this release failed its check: {reason}", file=sys.stderr, flush=True)
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(_EXIT_S)
            os._exit(EXIT_FAILED)

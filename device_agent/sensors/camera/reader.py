"""Reads one camera in a thread of its own, which connects again after each failure."""

import threading
import time
from collections.abc import Iterator
from typing import Protocol

from device_agent.ports.sensor import Frame, SensorError
from device_agent.ports.threads import Recovery, SupervisedThread

_RETRY_S = (1.0, 30.0)
"""First and maximum pause before the next attempt [s]."""
_REJECTED_RETRY_S = 60.0
"""Pause after rejected credentials [s]: cameras lock an account after several failures in a row."""
_ATTEMPT_S = 5.0
"""An attempt without a frame is ended after this time and ``stale_s`` [s]; a decoder process takes seconds to start."""
_END_S = 1.0


class RejectedError(SensorError):
    """The camera does not accept user and password."""


class FrameSource(Protocol):
    """Connects to one camera. A new attempt calls ``frames`` again."""

    def frames(self) -> Iterator[Frame]:
        """Connect and yield frames until the camera ends the stream.

        Raises:
            SensorError: The camera cannot be reached or sends invalid data; the message names what to check.
            RejectedError: The camera does not accept user and password.
        """

    def abort(self) -> None:
        """End a running ``frames``, from any thread. Also ends one that waits for the camera."""


class CameraReader:
    """The newest frame of one camera, and why there is none.

    Args:
        source: The camera.
        device: Name of the device.
        stale_s: Age at which the newest frame is no longer shown [s].
    """

    def __init__(self, source: FrameSource, *, device: str, stale_s: float) -> None:
        self._source = source
        self._stale_s = stale_s
        self._changed = threading.Condition()
        self._newest: Frame | None = None
        self._failure = ""
        self._progress_s = time.monotonic()
        self._stopping = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name=f"{device}-camera",
            part="reader of the camera",
            device=device,
            stopping=self._stopping,
            recovery=Recovery.RESTART,
        )

    def start(self) -> None:
        """Start to read."""
        self._thread.start()

    def frame(self) -> Frame:
        """The newest frame.

        Raises:
            SensorError: There is none, or it is old. The message contains the reason.
        """
        with self._changed:
            newest, failure = self._newest, self._failure
        if newest is not None and time.monotonic() - newest.taken_s <= self._stale_s:
            return newest
        raise SensorError(failure or f"the camera has sent no new picture for {self._stale_s:g} s; check the camera")

    def wait(self, timeout_s: float) -> None:
        """Wait until there is a fresh frame or a reason for its absence, at most ``timeout_s`` [s].

        Also ends an attempt that makes no progress, so that the next one starts.

        Raises:
            SensorError: There is no fresh frame.
        """
        if time.monotonic() - self._progress_s > self._stale_s + _ATTEMPT_S:
            self._progress_s = time.monotonic()
            self._source.abort()
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or bool(self._failure), timeout_s)
        self.frame()

    def close(self) -> None:
        """End the thread and the connection. May be called repeatedly."""
        self._stopping.set()
        self._source.abort()
        self._thread.join(_END_S)

    def _run(self) -> None:
        pause_s = _RETRY_S[0]
        while not self._stopping.is_set():
            self._progress_s = time.monotonic()
            try:
                for frame in self._source.frames():
                    self._accept(frame)
                    pause_s = _RETRY_S[0]
                    if self._stopping.is_set():
                        break
                self._fail("the camera has ended the stream; the agent connects again")
            except RejectedError as error:
                self._fail(str(error))
                pause_s = _REJECTED_RETRY_S
            except SensorError as error:
                self._fail(str(error))
            self._stopping.wait(pause_s)
            pause_s = min(2 * pause_s, _RETRY_S[1])

    def _accept(self, frame: Frame) -> None:
        with self._changed:
            self._newest, self._failure = frame, ""
            self._progress_s = frame.taken_s
            self._changed.notify_all()

    def _fail(self, reason: str) -> None:
        with self._changed:
            self._failure = reason
            self._changed.notify_all()

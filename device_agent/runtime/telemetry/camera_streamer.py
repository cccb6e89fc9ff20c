"""Streams camera frames, in a thread that may wait.

Rendering or taking a picture costs far more than the rest of an idle robot. The agent does not know its viewers, but
it knows whether the robot is controlled. During control and for a while after, each camera streams at its own rate;
otherwise once a second. Without a link no frames are sent. Frames for a recording do not depend on link and viewers.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

from device_agent.ports.driver import DriverError, HasCameras
from device_agent.ports.sensor import Frame
from device_agent.protocol import Stream
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.telemetry.periodic_poller import PeriodicPoller

IDLE_PERIOD_S = 1.0
"""Time between two frames of a robot without control [s]."""
LINGER_S = 60.0
"""Time after the end of control in which cameras keep their rate, because the operator may still watch [s]."""


class FrameRecording(Protocol):
    """Records frames of the cameras of a device; never blocks."""

    def is_due(self, camera: str, now_s: float) -> bool:
        """Whether a frame would be recorded that the camera takes now."""

    def record(self, camera: str, picture: Frame) -> None:
        """Record a frame if that is due."""


class CameraStreamer(PeriodicPoller):
    """Polls a driver for camera frames; publishes and records them."""

    def __init__(
        self,
        cameras: Sequence[Stream],
        driver: HasCameras | None,
        *,
        name: str,
        publish: Callable[[str, CameraFrame], None],
        is_controlled: Callable[[], bool],
        load: LoadGovernor,
        recording: FrameRecording | None = None,
    ) -> None:
        sources = () if driver is None else cameras
        super().__init__(sources, self._stream, device=name, kind="camera", share=lambda: load.share("cameras"))
        self._publish = publish
        self._is_controlled = is_controlled
        self._recording = recording
        self._linked = False
        self._controlled_s = -math.inf
        self._last_frame_s: dict[str, float] = {}
        self._driver = driver
        self._sequences: Counter[str] = Counter()

    def link_changed(self, up: bool) -> None:
        """Pause without a link."""
        self._linked = up

    def _is_due(self, camera: str) -> bool:
        now_s = time.monotonic()
        if self._is_controlled():
            self._controlled_s = now_s
        live = now_s - self._controlled_s <= LINGER_S
        if not self._linked or not (live or now_s - self._last_frame_s.get(camera, -math.inf) >= IDLE_PERIOD_S):
            return False
        self._last_frame_s[camera] = now_s
        return True

    def _stream(self, camera: str) -> None:
        publish = self._is_due(camera)
        if not publish and (self._recording is None or not self._recording.is_due(camera, time.monotonic())):
            return
        picture = None if self._driver is None else self._driver.frame(camera)
        if picture is None:
            return
        if self._recording is not None:
            self._recording.record(camera, picture)
        if not publish:
            return
        self._sequences[camera] += 1
        tick = round(picture.taken_s * 1000)
        frame = CameraFrame(self._sequences[camera], tick, picture.width, picture.height, picture.content)
        try:
            self._publish(camera, frame)
        except ProtocolError as error:
            raise DriverError(f"{error}; configure smaller pictures") from error

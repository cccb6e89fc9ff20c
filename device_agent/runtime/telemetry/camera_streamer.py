"""What a robot sees, camera by camera, in a thread that may wait: beside all that moves it.

Drawing or taking a picture costs far more than anything else that a robot at rest does. The agent is not told who looks
at it, but knows whether somebody controls it: while they do, and for a while after, each camera films at its own rate;
else once a second, which is enough to see that the eyes are open. While the link is down nothing is filmed.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence

from device_agent.ports.driver import DriverError, HasCameras
from device_agent.protocol import Stream
from device_agent.protocol.camera_frames import CameraFrame
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.telemetry.periodic_poller import PeriodicPoller

IDLE_PERIOD_S = 1.0
"""From one picture to the next of a robot that nobody controls."""
LINGER_S = 60.0
"""After the end of control pictures go on as before for so long: who has just let go still looks."""


class CameraStreamer:
    """Asks a driver for pictures, and tells them.

    Args:
        cameras: Those of the robot type, with how many pictures a second.
        driver: What takes them; ``None``: it has no eyes.
        name: The device's name.
        film: Called with a camera's name and its picture; must not block.
        controlled: Whether somebody controls the robot.
        linger_s: See ``LINGER_S``.
    """

    def __init__(
        self,
        cameras: Sequence[Stream],
        driver: HasCameras | None,
        *,
        name: str,
        film: Callable[[str, CameraFrame], None],
        controlled: Callable[[], bool],
        linger_s: float = LINGER_S,
    ) -> None:
        self._film = film
        self._controlled = controlled
        self._linger_s = linger_s
        self._linked = False
        self._controlled_s = -math.inf
        self._filmed_s: dict[str, float] = {}
        self._driver = driver
        self._taken: Counter[str] = Counter()
        self._rounds = PeriodicPoller(() if driver is None else cameras, self._shoot, device=name, what="camera")

    def start(self) -> None:
        """Begin, where there is something to film."""
        self._rounds.start()

    def stop(self) -> None:
        """End. May be called twice."""
        self._rounds.stop()

    def link_changed(self, up: bool) -> None:
        """The link came or went: without one nobody sees anything."""
        self._linked = up

    def _wanted(self, camera: str) -> bool:
        now_s = time.monotonic()
        if self._controlled():
            self._controlled_s = now_s
        live = now_s - self._controlled_s <= self._linger_s
        if not self._linked or not (live or now_s - self._filmed_s.get(camera, -math.inf) >= IDLE_PERIOD_S):
            return False
        self._filmed_s[camera] = now_s
        return True

    def _shoot(self, camera: str) -> None:
        if not self._wanted(camera):
            return
        picture = None if self._driver is None else self._driver.frame(camera)
        if picture is None:
            return
        self._taken[camera] += 1
        tick = round(picture.taken_s * 1000)
        frame = CameraFrame(self._taken[camera], tick, picture.width, picture.height, picture.content)
        try:
            self._film(camera, frame)
        except ProtocolError as error:
            raise DriverError(f"{error}; have it take smaller pictures") from error

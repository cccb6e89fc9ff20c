"""What a robot sees, camera by camera at its own rate, in a thread that may wait: beside all that moves it."""

from collections import Counter
from collections.abc import Callable, Sequence

from device_agent.ports.driver import DriverError, Filming
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.frames import CameraFrame
from device_agent.protocol.messages import Stream
from device_agent.runtime.rounds import Rounds


class Filmer:
    """Asks a driver for pictures, and tells them.

    Args:
        cameras: Those of the robot type, with how many pictures a second.
        driver: What takes them; ``None``: it has no eyes.
        name: The device's name.
        film: Called with a camera's name and its picture; must not block.
    """

    def __init__(
        self,
        cameras: Sequence[Stream],
        driver: Filming | None,
        *,
        name: str,
        film: Callable[[str, CameraFrame], None],
    ) -> None:
        self._film = film
        self._driver = driver
        self._taken: Counter[str] = Counter()
        self._rounds = Rounds(() if driver is None else cameras, self._shoot, device=name, what="camera")

    def start(self) -> None:
        """Begin, where there is something to film."""
        self._rounds.start()

    def stop(self) -> None:
        """End. May be called twice."""
        self._rounds.stop()

    def _shoot(self, camera: str) -> None:
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

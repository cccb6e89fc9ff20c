"""A driver without physics: the joint is where it was commanded."""

from collections.abc import Callable, Sequence

from device_agent.ports.driver import DriverError, Observation
from device_agent.protocol import Twin

JOINT = "elbow"


class KinematicDriver:
    """One joint. ``sent`` receives each commanded position.

    Attributes:
        slow_s: How long each observation takes [s].
        broken: Whether the device does not respond.
    """

    simulated = True

    def __init__(self, position_rad: float, sent: Callable[[float], None], sleep: Callable[[float], object]) -> None:
        self.position_rad = position_rad
        self.slow_s = 0.0
        self.broken = False
        self._halted = False
        self._sent = sent
        self._sleep = sleep

    def connect(self) -> None:
        self._check()
        self._halted = False

    def halt(self) -> None:
        self._halted = True

    def twin(self) -> Twin | None:
        return None

    def observe(self) -> Observation:
        if self.slow_s:
            self._sleep(self.slow_s)
        self._check()
        return Observation((self.position_rad,), (0.0,), (0.0,), ())

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        self._check()
        if self._halted:
            raise DriverError("the device was halted; connect again")
        self.position_rad = position_rad[0]
        self._sent(self.position_rad)
        return tuple(position_rad)

    def close(self) -> None:
        """Nothing is open."""

    def _check(self) -> None:
        if self.broken:
            raise DriverError("no answer from the arm")

"""One copy of the world's state for all sensors that look at positions or cast rays: they are quick and take turns."""

import contextlib
import threading
import time
import weakref
from collections.abc import Iterator
from typing import Any

import mujoco

from device_agent.ports.driver import DriverError
from device_agent.ports.sensor import SensorError
from device_agent.ports.simulation import SimulatedWorld

OLDEST_S = 0.02
"""What is seen is no older than this: a person walks 2 cm in it."""


class View:
    """The copy. The world it is of must be open while somebody looks."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._lock = threading.Lock()
        self._data: Any = None
        self._taken_s = float("-inf")

    @contextlib.contextmanager
    def look(self) -> Iterator[tuple[Any, float]]:
        """The state as ``MjData``, and when it was taken [s]. For a moment: others wait.

        Raises:
            SensorError: The world has stopped.
        """
        with self._lock:
            if time.monotonic() - self._taken_s > OLDEST_S:
                try:
                    if self._data is None:
                        self._data = mujoco.MjData(self._world.model)
                    self._world.copy(self._data)
                except DriverError as error:
                    raise SensorError(str(error)) from error
                self._taken_s = time.monotonic()
            yield self._data, self._taken_s


_views: "weakref.WeakKeyDictionary[SimulatedWorld, View]" = weakref.WeakKeyDictionary()
_making = threading.Lock()


def view_of(world: SimulatedWorld) -> View:
    """The one of this world."""
    with _making:
        if world not in _views:
            _views[world] = View(weakref.proxy(world))
        return _views[world]

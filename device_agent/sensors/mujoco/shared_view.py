"""One copy of the world's state, shared by the sensors that read positions or cast rays."""

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
"""Maximum age of the copy: a person walks 2 cm in this time."""


class View:
    """The copy. The world must be open during ``current``."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._lock = threading.Lock()
        self._data: Any = None
        self._taken_s = float("-inf")

    @contextlib.contextmanager
    def current(self) -> Iterator[tuple[Any, float]]:
        """The state as ``MjData``, and its time [s]. Blocks other sensors.

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
_views_lock = threading.Lock()


def view_of(world: SimulatedWorld) -> View:
    """The view of this world."""
    with _views_lock:
        if world not in _views:
            _views[world] = View(weakref.proxy(world))
        return _views[world]

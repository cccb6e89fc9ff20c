"""Control and streams of the objects in the scene of a simulated robot."""

from collections.abc import Mapping
from typing import Any

from device_agent.ports.skills import BehaviourContext, SkillError
from device_agent.protocol import Control
from device_agent.simulation.snapshot import Snapshot
from device_agent.simulation.tasks.scene_objects import SceneObjects

RESET = "reset_objects"
"""Control: the seed of a reset of the objects."""
SETTINGS, OBJECTS = "settings", "objects"
"""Streams: values that can be set; poses and sizes of objects."""
MAX_SEED = 1_000_000
"""A slider has 100 steps, so that each of them is a whole number."""
_POLL_S = 0.02
_RESET_S = 2.0


class ObjectControls:
    """What a driver needs to reset and report the objects of its scene.

    Attributes:
        controls: The reset, if there are objects.
        settings: The last seed by name of the control; empty before a reset.

    Args:
        objects: Objects of the scene, if there are any.
    """

    def __init__(self, objects: SceneObjects | None) -> None:
        self._objects = objects
        reset = Control(name=RESET, label="Reset of the objects (seed)", lower=0, upper=MAX_SEED)
        self.controls = () if objects is None else (reset,)
        self.settings: Mapping[str, float] = {}

    def resolve(self, model: Any) -> None:
        """Find the objects in a compiled model.

        Raises:
            DriverError: An object is missing or cannot be used.
        """
        if self._objects is not None:
            self._objects.resolve(model)

    def poses(self, snapshot: Snapshot, base: int) -> Mapping[str, float]:
        """Poses and sizes in the frame of a body; see ``SceneObjects.poses``."""
        return {} if self._objects is None else self._objects.poses(snapshot, base)

    def reset(self, value: float, context: BehaviourContext) -> float:
        """Reset the objects to a seed, and return it.

        Raises:
            SkillError: The value is not a whole number, or the reset is rejected or late.
        """
        if self._objects is None or value != round(value):
            raise SkillError(f"the seed of a reset is a whole number, not {value:g}")
        reset, waited_s = self._objects.request(round(value)), 0.0
        while not reset.finished.is_set():
            if context.wait(_POLL_S) or waited_s > _RESET_S:
                reset.withdrawn = True
                raise SkillError("the simulation has not reset the objects in time")
            waited_s += _POLL_S
        if reset.rejection:
            raise SkillError(reset.rejection)
        self.settings = {RESET: float(reset.seed)}
        return value

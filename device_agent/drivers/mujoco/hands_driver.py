"""Driver of a simulated humanoid whose hands are joints, in a scene with objects."""

from collections.abc import Mapping
from typing import Any

from device_agent.drivers.mujoco.biped_driver import BipedDriver
from device_agent.drivers.mujoco.object_controls import OBJECTS, SETTINGS, ObjectControls
from device_agent.ports.driver import DriverError
from device_agent.ports.skills import BehaviourContext, SkillError
from device_agent.protocol import Control
from device_agent.simulation.tasks.scene_objects import SceneObjects


class HandsDriver(BipedDriver):
    """Adds the reset of the scene's objects, which implements ``HasControls``, and the streams of the objects.

    Args:
        objects: Objects of the scene.
        options: As for ``BipedDriver``.
    """

    def __init__(self, *, objects: SceneObjects, **options: Any) -> None:
        super().__init__(**options)
        self._objects = ObjectControls(objects)

    @property
    def controls(self) -> tuple[Control, ...]:
        """The reset of the objects."""
        return self._objects.controls

    def set_control(self, name: str, value: float, context: BehaviourContext) -> float:
        """Reset the objects to a seed, and return it.

        Raises:
            SkillError: Not connected, halted, or the reset is rejected.
        """
        del name
        try:
            self._live()
            self._check_halted()
        except DriverError as error:
            raise SkillError(str(error)) from error
        return self._objects.reset(value, context)

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``objects``: poses and sizes of the objects; ``settings``: the last seed. All others as ``BipedDriver``."""
        if stream not in {OBJECTS, SETTINGS}:
            return super().report(stream)
        if not self._connected:
            return {}
        return self._objects.settings if stream == SETTINGS else self._objects.poses(self._live(), self._base)

    def _resolve(self, model: Any) -> None:
        super()._resolve(model)
        self._objects.resolve(model)

"""Verdict about one task, from the state of the simulation only."""

from typing import Any

from device_agent.protocol.manifests.tasks import Tasks
from device_agent.simulation.tasks.conditions import Condition, condition_of

_EPSILON_S = 1e-6


class SuccessMonitor:
    """``Process`` that observes whether the condition of a task is met.

    Args:
        manifest: Objects, joints and regions.
        task: Name of one of its tasks.

    Raises:
        ProtocolError: The task is unknown.
    """

    def __init__(self, manifest: Tasks, task: str) -> None:
        self._manifest = manifest
        self._success = manifest.task(task).success
        self._condition: Condition | None = None
        self._rest_since_s: float | None = None
        self._time_s = 0.0

    @property
    def lifted(self) -> bool:
        """Whether a robot has lifted the object, in contact with nothing else, or moved the joint."""
        return self._condition is not None and self._condition.reached

    @property
    def rest_s(self) -> float:
        """Time for which the whole condition has been met until now [s]; 0 while it is not met."""
        return 0.0 if self._rest_since_s is None else self._time_s - self._rest_since_s

    @property
    def met(self) -> bool:
        """Whether the task is complete now."""
        return self._rest_since_s is not None and self.rest_s >= self._success.rest_s - _EPSILON_S

    @property
    def shortfall(self) -> str:
        """What is missing, for operators; empty if the task is complete."""
        if self.met:
            return ""
        if self._condition is None:
            return "nothing was observed"
        return self._condition.incomplete if self._condition.reached else self._condition.unreached

    def restart(self) -> None:
        """Observe a new trial from the next group of steps on: the object starts where it is then."""
        self._condition = self._rest_since_s = None

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """See ``Process``."""
        if self._condition is None:
            self._condition = condition_of(model, self._manifest, self._success)
        self._time_s = time_s
        if not self._condition.evaluate(data):
            self._rest_since_s = None
        elif self._rest_since_s is None:
            self._rest_since_s = time_s

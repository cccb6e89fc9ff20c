"""Conditions that complete tasks, each evaluated from the state of the simulation only."""

from typing import Any, Protocol

import numpy as np

from device_agent.protocol.manifests.tasks import Region, Success, Tasks
from device_agent.simulation.tasks.scene_joint import ArticulatedJoint, subtree

_REST_M_S, _REST_RAD_S = 0.01, 0.1
"""Velocities below which an object is at rest."""


class Condition(Protocol):
    """What completes a task.

    Attributes:
        reached: Whether a robot has lifted the object or moved the joint.
        unreached: Why the task is not complete if it has not, for operators.
        incomplete: Why the task is not complete otherwise, for operators.
    """

    reached: bool
    unreached: str
    incomplete: str

    def evaluate(self, data: Any) -> bool:
        """Whether the condition is met now."""
        ...


def condition_of(model: Any, manifest: Tasks, success: Success) -> Condition:
    """The condition of a task in a compiled model."""
    if success.joint is not None:
        return OpenedJoint(model, manifest, success)
    if success.region is None:
        return HeldObject(model, manifest, success)
    return PlacedObject(model, manifest, success, manifest.region(success.region))


class PlacedObject:
    """A robot has lifted the object, which is now at rest in a region without contact to a robot."""

    unreached = "the robot did not lift the object"
    incomplete = "the object did not come to rest in its region"

    def __init__(self, model: Any, manifest: Tasks, success: Success, region: Region) -> None:
        self.reached = False
        self._held = HeldObject(model, manifest, success)
        self._body = int(model.body(str(success.object)).id)
        self._dof = int(model.jnt_dofadr[model.body_jntadr[self._body]])
        self._point = np.array(success.point_m)
        joints = {each.name for each in manifest.joints}
        self._part = 0  # the world
        if region.part is not None:
            self._part = (
                int(model.joint(region.part).bodyid[0]) if region.part in joints else model.body(region.part).id
            )
        self._lower, self._upper = np.array(region.lower_m), np.array(region.upper_m)

    def evaluate(self, data: Any) -> bool:
        """See ``Condition``."""
        self.reached |= self._held.evaluate(data)
        velocity = np.abs(data.qvel[self._dof : self._dof + 6])
        rests = velocity[:3].max() < _REST_M_S and velocity[3:].max() < _REST_RAD_S
        point = data.xpos[self._body] + data.xmat[self._body].reshape(3, 3) @ self._point
        point = data.xmat[self._part].reshape(3, 3).T @ (point - data.xpos[self._part])
        inside = np.all((self._lower <= point) & (point <= self._upper))
        return bool(self.reached and rests and inside and not self._held.touched_by_robot)


class HeldObject:
    """A robot holds the object at a height above its start, in contact with nothing else.

    Attributes:
        touched_by_robot: Whether a robot touches the object now.
    """

    unreached = "the robot did not lift the object"
    incomplete = "the robot did not hold the object for long enough"

    def __init__(self, model: Any, manifest: Tasks, success: Success) -> None:
        self.reached = self.touched_by_robot = False
        self._body = int(model.body(str(success.object)).id)
        self._contacts = _Contacts(model, manifest, {self._body})
        self._lifted_m = success.lifted_m or 0.0
        self._start_m: float | None = None

    def evaluate(self, data: Any) -> bool:
        """See ``Condition``."""
        self.touched_by_robot, by_others = self._contacts.evaluate(data)
        height_m = float(data.xpos[self._body, 2])
        if self._start_m is None:
            self._start_m = height_m
        held = self.touched_by_robot and not by_others and height_m >= self._start_m + self._lifted_m
        self.reached |= held
        return held


class OpenedJoint:
    """A robot has moved the joint, which is now at rest without contact to a robot."""

    unreached = "the robot did not move the joint far enough"
    incomplete = "the joint did not stay at its position without contact to the robot"

    def __init__(self, model: Any, manifest: Tasks, success: Success) -> None:
        self.reached = False
        self._joint = ArticulatedJoint(model, str(success.joint))
        self._contacts = _Contacts(model, manifest, subtree(model, {self._joint.index}))
        self._at_least = success.at_least or 0.0

    def evaluate(self, data: Any) -> bool:
        """See ``Condition``."""
        by_robot, _ = self._contacts.evaluate(data)
        opened = bool(data.qpos[self._joint.qpos] >= self._at_least)
        self.reached |= by_robot and opened
        rests = abs(float(data.qvel[self._joint.dof])) < _REST_M_S
        return self.reached and opened and rests and not by_robot


class _Contacts:
    """What touches some bodies."""

    def __init__(self, model: Any, manifest: Tasks, bodies: set[int]) -> None:
        of = model.geom_bodyid
        parts = {int(model.body(each.name).id) for each in manifest.objects}
        parts |= {int(model.joint(each.name).bodyid[0]) for each in manifest.joints}
        self._own = np.isin(of, list(bodies))
        self._robots = (model.body_weldid[of] != 0) & ~np.isin(of, list(subtree(model, parts)))

    def evaluate(self, data: Any) -> tuple[bool, bool]:
        """Whether a robot touches the bodies, and whether anything else does."""
        pairs = data.contact.geom[: data.ncon]
        first, second = self._own[pairs[:, 0]], self._own[pairs[:, 1]]
        others = np.concatenate((pairs[first, 1], pairs[second, 0]))
        robots = self._robots[others]
        return bool(robots.any()), bool((~robots).any())

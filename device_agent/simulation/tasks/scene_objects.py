"""Objects of a scene that a seeded reset places at random, within the ranges of the scene's manifest."""

import math
import queue
import threading
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from device_agent.ports.driver import DriverError
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import tasks
from device_agent.protocol.manifests.tasks import SceneObject, Tasks
from device_agent.simulation.snapshot import Snapshot
from device_agent.simulation.tasks.free_body import FreeBody
from device_agent.simulation.tasks.scene_joint import ArticulatedJoint, subtree
from device_agent.simulation.world import World

NEAR_M = 0.02
"""A robot that is closer to an object, or to its new place, prevents a reset [m]."""
_AT_REST = 0.05
"""Joint velocity below which a robot is at rest [rad/s or m/s]."""
_ATTEMPTS = 1000
"""Random places for one object before a reset fails."""


class ObjectReset:
    """One requested reset.

    Attributes:
        seed: Seed of the random numbers.
        finished: Set when the reset has been applied or rejected.
        withdrawn: Set by the caller that does not wait any longer: the reset is not applied.
        rejection: Why it was rejected; empty if it was applied.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.finished = threading.Event()
        self.withdrawn = False
        self.rejection = ""


class SceneObjects:
    """``Process`` that resets the objects of one world.

    A reset moves objects and joints of the scene only. It is rejected while a robot moves, touches an object or is near
    one or its new place. Equal seeds give equal places, sizes, masses, friction and light. All but the places change in
    the ``MjModel``, which no other thread uses for dynamics.

    Args:
        manifest: Objects and their ranges.
    """

    def __init__(self, manifest: Tasks) -> None:
        self.manifest = manifest
        self._requests: queue.SimpleQueue[ObjectReset] = queue.SimpleQueue()
        self._bodies: dict[str, FreeBody] = {}
        self._joints: dict[str, ArticulatedJoint] = {}
        self._robots: tuple[int, ...] = ()
        self._light: Any = None

    def resolve(self, model: Any) -> None:
        """Find the objects and joints in a compiled model. May be called repeatedly.

        Raises:
            DriverError: An object is missing or has no free joint, or a joint is missing.
        """
        if not self._bodies:
            self._joints = {each.name: ArticulatedJoint(model, each.name) for each in self.manifest.joints}
            self._bodies = {each.name: FreeBody(model, each.name) for each in self.manifest.objects}
            self._light = model.light_diffuse.copy()
            own = subtree(model, {part.index for part in self._parts.values()})
            self._robots = tuple(
                geom
                for geom in range(model.ngeom)
                if model.geom_contype[geom] and model.body_weldid[model.geom_bodyid[geom]] not in {0, *own}
            )

    @property
    def _parts(self) -> Mapping[str, FreeBody | ArticulatedJoint]:
        """Objects and joints by name."""
        return {**self._bodies, **self._joints}

    def request(self, seed: int) -> ObjectReset:
        """Request a reset before the next group of steps. Thread-safe; returns immediately."""
        reset = ObjectReset(seed)
        self._requests.put(reset)
        return reset

    def poses(self, snapshot: Snapshot, base: int) -> Mapping[str, float]:
        """Pose and size of each object, as a camera could measure them: in the frame of a body, by name.

        ``x_m``, ``y_m``, ``z_m`` and ``yaw_rad`` of its center; ``length_m``, ``width_m`` and ``height_m`` along the
        object's own x, y and z axes. For a joint, the pose of its body and the joint's ``position``.
        """
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, snapshot.body_quaternion[base])
        to_base, origin = matrix.reshape(3, 3).T.copy(), snapshot.body_position_m[base]
        values: dict[str, float] = {}
        for name, part in self._parts.items():
            mujoco.mju_quat2Mat(matrix, snapshot.body_quaternion[part.index])
            axis = to_base @ matrix.reshape(3, 3)[:, 0]
            for field, value in zip("xyz", (to_base @ (snapshot.body_position_m[part.index] - origin)), strict=True):
                values[f"{field}_m.{name}"] = round(float(value), 5)
            values[f"yaw_rad.{name}"] = round(math.atan2(axis[1], axis[0]), 5)
        for name, body in self._bodies.items():
            for field, size_m in zip(("length", "width", "height"), body.size_m, strict=True):
                values[f"{field}_m.{name}"] = round(size_m, 5)
        for name, joint in self._joints.items():
            values[f"position.{name}"] = round(float(snapshot.qpos[joint.qpos]), 5)
        return values

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """See ``Process``."""
        del time_s
        while True:
            try:
                reset = self._requests.get_nowait()
            except queue.Empty:
                return
            if reset.withdrawn:
                continue
            try:
                self._apply(model, data, reset.seed)
            except DriverError as error:
                reset.rejection = str(error)
            reset.finished.set()

    def _apply(self, model: Any, data: Any, seed: int) -> None:
        """Place all objects, or none.

        Raises:
            DriverError: A robot moves or is near, or the ranges leave no room for an object.
        """
        self._check_rest(model, data)
        self._check_clear(model, data, "")
        random = np.random.default_rng(seed)
        before, scales = data.qpos.copy(), {name: body.scale for name, body in self._bodies.items()}
        try:
            self._place(model, data, random)
            mujoco.mj_kinematics(model, data)
            self._check_clear(model, data, "the new place of ")
        except DriverError:
            for name, scale in scales.items():
                self._bodies[name].set_scale(model, scale)
            data.qpos[:] = before
            mujoco.mj_kinematics(model, data)
            raise
        for each in self.manifest.objects:
            body = self._bodies[each.name]
            data.qvel[body.dof : body.dof + 6] = data.qacc_warmstart[body.dof : body.dof + 6] = 0.0
            body.set_mass(model, random.uniform(*each.mass_kg))
            body.set_friction(model, random.uniform(*each.friction))
        for joint in self.manifest.joints:
            part = self._joints[joint.name]
            data.qvel[part.dof] = data.qacc_warmstart[part.dof] = 0.0
            part.set_resistance(model, random.uniform(*joint.friction), random.uniform(*joint.damping))
        model.light_diffuse[:] = self._light * random.uniform(*self.manifest.light)

    def _place(self, model: Any, data: Any, random: np.random.Generator) -> None:
        """Set size and pose of all objects, and the positions of the joints.

        Raises:
            DriverError: The ranges leave no room for an object.
        """
        placed: list[tuple[float, float, float]] = []
        for each in self.manifest.objects:
            body = self._bodies[each.name]
            body.set_scale(model, random.uniform(*each.size_scale))
            body.place(data, *self._sample(each, random, placed))
            x_m, y_m = data.qpos[body.qpos : body.qpos + 2].tolist()
            placed.append((x_m, y_m, body.radius_m))
        for joint in self.manifest.joints:
            self._joints[joint.name].set_position(data, random.uniform(*joint.position))

    def _sample(
        self, each: SceneObject, random: np.random.Generator, placed: Sequence[tuple[float, float, float]]
    ) -> tuple[float, float, float]:
        """A random x, y [m] and yaw [rad] with the manifest's gap to the objects that are already placed."""
        radius_m = self._bodies[each.name].radius_m
        for _ in range(_ATTEMPTS):
            x_m, y_m = random.uniform(each.lower_m, each.upper_m).tolist()
            yaw_rad = float(random.uniform(*each.yaw_rad))
            if all(math.hypot(x_m - x, y_m - y) >= radius_m + r + self.manifest.gap_m for x, y, r in placed):
                return x_m, y_m, yaw_rad
        raise DriverError(
            f"the ranges in {tasks.MANIFEST} leave no place for '{each.name}' with a gap of {self.manifest.gap_m:g} m"
        )

    def _check_rest(self, model: Any, data: Any) -> None:
        own = subtree(model, {part.index for part in self._parts.values()})
        moving = np.flatnonzero(np.abs(data.qvel) > _AT_REST)
        names = [model.body(body).name for body in model.dof_bodyid[moving] if int(body) not in own]
        if names:
            raise DriverError(f"'{names[0]}' moves; reset the objects while every robot is at rest")

    def _check_clear(self, model: Any, data: Any, place: str) -> None:
        for name, part in self._parts.items():
            for geom in part.geoms:
                for robot in self._robots:
                    if mujoco.mj_geomDistance(model, data, geom, robot, 2 * NEAR_M, None) < NEAR_M:
                        owner = model.body(model.geom_bodyid[robot]).name
                        raise DriverError(
                            f"'{owner}' is within {NEAR_M * 1000:.0f} mm of {place}'{name}'; open the gripper and move "
                            "the robot away, then reset the objects"
                        )


_objects: "weakref.WeakKeyDictionary[World, SceneObjects | None]" = weakref.WeakKeyDictionary()
_lock = threading.Lock()


def objects_of(world: World) -> SceneObjects | None:
    """The objects of a world, shared by its robots; ``None`` if its scene has no manifest of objects.

    Raises:
        DriverError: The manifest is wrong.
    """
    with _lock:
        if world not in _objects:
            try:
                manifest = tasks.load(world.scene)
            except ProtocolError as error:
                raise DriverError(str(error)) from error
            here = manifest is not None and manifest.scene in {"", world.scene.name}
            has_parts = manifest is not None and bool(manifest.objects or manifest.joints)
            _objects[world] = SceneObjects(manifest) if manifest is not None and here and has_parts else None
            if (created := _objects[world]) is not None:
                world.add(created)
        return _objects[world]

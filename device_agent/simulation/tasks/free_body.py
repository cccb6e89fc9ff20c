"""One object of a scene on a free joint, whose pose and properties a reset changes."""

import math
from typing import Any

import mujoco
import numpy as np

from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests import tasks


class FreeBody:
    """Indices and original properties of one object in the model.

    Attributes:
        index: Its body.
        qpos: First index of its pose in ``qpos``.
        dof: First index of its velocity in ``qvel``.
        geoms: Indices of its shapes.
        scale: Present size as a share of that in the model's file.

    Args:
        model: The compiled ``MjModel``.
        name: Name of the body.

    Raises:
        DriverError: The body is missing or has no free joint, or a shape of it is a mesh.
    """

    def __init__(self, model: Any, name: str) -> None:
        self.index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
        joint = int(model.body_jntadr[self.index]) if self.index >= 0 else -1
        if joint < 0 or model.jnt_type[joint] != int(mujoco.mjtJoint.mjJNT_FREE):
            raise DriverError(f"{tasks.MANIFEST}: the scene has no body '{name}' with a free joint")
        self.qpos, self.dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        first = int(model.body_geomadr[self.index])
        shapes = slice(first, first + int(model.body_geomnum[self.index]))
        if (model.geom_dataid[shapes] >= 0).any():
            raise DriverError(f"{tasks.MANIFEST}: a shape of '{name}' is a mesh; its size could not change")
        self.geoms = tuple(range(shapes.start, shapes.stop))
        self._dofs = slice(self.dof, self.dof + 6)
        tree = slice(model.body_bvhadr[self.index], model.body_bvhadr[self.index] + model.body_bvhnum[self.index])
        # All lengths that the collision detection uses.
        self._lengths = tuple(
            (field, part, getattr(model, field)[part].copy())
            for field, part in (
                ("geom_size", shapes),
                ("geom_pos", shapes),
                ("geom_aabb", shapes),
                ("geom_rbound", shapes),
                ("bvh_aabb", tree),
                ("body_ipos", slice(self.index, self.index + 1)),
            )
        )
        self._mass_kg = float(model.body_mass[self.index])
        self._inertia = model.body_inertia[self.index].copy()
        self._inverse = model.body_invweight0[self.index].copy(), model.dof_invweight0[self._dofs].copy()
        self._height_m = float(model.qpos0[self.qpos + 2])
        lower_m, upper_m = _bounds(model, shapes)
        self._size_m, self._below_m = upper_m - lower_m, -float(lower_m[2])
        self._radius_m = float(np.hypot(*np.maximum(-lower_m, upper_m)[:2]))
        self.scale = 1.0

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Present extent along its own axes [m]."""
        x_m, y_m, z_m = (float(each) for each in self._size_m * self.scale)
        return x_m, y_m, z_m

    @property
    def radius_m(self) -> float:
        """Present radius of a circle around its shapes, seen from above [m]."""
        return self._radius_m * self.scale

    def place(self, data: Any, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Set the pose. The lowest point keeps the height that it has in the model's file."""
        half, height_m = yaw_rad / 2, self._height_m + (self.scale - 1) * self._below_m
        data.qpos[self.qpos : self.qpos + 7] = x_m, y_m, height_m, math.cos(half), 0.0, 0.0, math.sin(half)

    def set_scale(self, model: Any, scale: float) -> None:
        """Set the size. ``set_mass`` must follow: the inertia depends on both."""
        self.scale = scale
        for field, part, original in self._lengths:
            getattr(model, field)[part] = original * scale

    def set_mass(self, model: Any, mass_kg: float) -> None:
        """Set the mass, and what depends on mass and size: the inertia, and values of the constraint solver."""
        mass, inertia = mass_kg / self._mass_kg, mass_kg / self._mass_kg * self.scale**2
        model.body_mass[self.index] = model.body_subtreemass[self.index] = mass_kg
        model.body_inertia[self.index] = self._inertia * inertia
        # First translation, then rotation.
        model.body_invweight0[self.index] = self._inverse[0] / (mass, inertia)
        model.dof_invweight0[self._dofs] = self._inverse[1] / np.repeat((mass, inertia), 3)

    def set_friction(self, model: Any, friction: float) -> None:
        """Set sliding friction of all shapes."""
        model.geom_friction[list(self.geoms), 0] = friction


def _bounds(model: Any, shapes: slice) -> tuple[Any, Any]:
    """Lowest and highest corner of a box around shapes, in the frame of their body [m]."""
    corners = []
    rotation = np.empty(9)
    for geom in range(shapes.start, shapes.stop):
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        axes, box = rotation.reshape(3, 3), model.geom_aabb[geom]
        center, half = model.geom_pos[geom] + axes @ box[:3], np.abs(axes) @ box[3:]
        corners.append((center - half, center + half))
    lower, upper = zip(*corners, strict=True)
    return np.min(lower, axis=0), np.max(upper, axis=0)

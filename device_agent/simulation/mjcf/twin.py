"""A compiled model as the protocol's ``Twin``: a tree of primitive shapes that a page can animate.

It contains the geoms of groups 0 to 2, as in MuJoCo's viewer; collision geoms belong in group 3.
"""

from typing import Any, Literal, cast

import mujoco
import numpy as np

from device_agent.ports.driver import DriverError
from device_agent.protocol import Body, Geometry, Quaternion, Twin, TwinJoint, Vector3
from device_agent.simulation.mjcf.equality_joints import SCALAR_JOINTS, EqualityJoints

_LAST_VISIBLE_GROUP = 2
_DIGITS = 12
"""Decimals written. A chain of ten bodies stays within 1e-10 m of MuJoCo's own poses."""
_IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
_ORIGIN: Vector3 = (0.0, 0.0, 0.0)

Shape = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane"]
_SHAPES: dict[int, Shape] = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}


def build_twin(model: Any, *, base: int, device: str, prefix: str = "", scenery_m: float = 0.0) -> Twin:
    """The twin of one robot, in the frame of its base.

    To compute a pose: start at the parent's; move by ``position_m`` and ``quaternion``; at a joint, turn about its axis
    through its anchor (or slide along it) by position minus ``reference_rad``. A joint that ``follows`` others has the
    sum of factor times position of those.

    Args:
        model: The compiled ``MjModel``.
        base: Index of the robot's top-level body.
        device: Id of the device.
        prefix: Removed from the names.
        scenery_m: Include static geoms within this distance of a static base, as a body ``scene`` [m]; 0 includes none.

    Raises:
        DriverError: A body below the base has a ball or free joint.
    """
    bodies: list[Body] = []
    index_of: dict[int, int] = {}
    equality_joints = EqualityJoints(model)
    if scenery_m > 0 and model.body_weldid[base] == 0:
        bodies.append(_scene(model, base, scenery_m))
    for body in range(base, model.nbody):
        if body == base:
            bodies.append(Body(name=_name(model, body, prefix), parent=-1, position_m=_ORIGIN, quaternion=_IDENTITY,
                               geometries=_shapes(model, body)))  # fmt: skip
        elif model.body_parentid[body] in index_of:
            parent = index_of[model.body_parentid[body]]
            bodies += _moving(model, body, parent, len(bodies), prefix=prefix, equality_joints=equality_joints)
        else:
            continue
        index_of[body] = len(bodies) - 1
    return Twin(device=device, bodies=tuple(bodies))


def _moving(
    model: Any, body: int, parent: int, first: int, *, prefix: str, equality_joints: EqualityJoints
) -> list[Body]:
    """The twin bodies of one model body: a chain if it has several joints."""
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    name = _name(model, body, prefix)
    position, quaternion = _vector(model.body_pos[body]), _quaternion(model.body_quat[body])
    geometries = _shapes(model, body)
    if model.body_jntnum[body] == 0:
        return [Body(name=name, parent=parent, position_m=position, quaternion=quaternion, geometries=geometries)]
    last = model.body_jntnum[body] - 1
    return [
        Body(
            name=name if step == last else f"{name}#{step}",
            parent=parent if step == 0 else first + step - 1,
            position_m=position if step == 0 else _ORIGIN,
            quaternion=quaternion if step == 0 else _IDENTITY,
            joint=_joint(model, joint, prefix, equality_joints),
            geometries=geometries if step == last else (),
        )
        for step, joint in enumerate(joints)
    ]


def _joint(model: Any, joint: int, prefix: str, equality_joints: EqualityJoints) -> TwinJoint:
    name = model.joint(joint).name.removeprefix(prefix)
    if model.jnt_type[joint] not in SCALAR_JOINTS:
        raise DriverError(f"joint '{name}' is neither a hinge nor a slide; a twin supports no other joints")
    return TwinJoint(
        name=name,
        kind="hinge" if model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_HINGE) else "slide",
        axis=_vector(model.jnt_axis[joint]),
        anchor_m=_vector(model.jnt_pos[joint]),
        reference_rad=_round(model.qpos0[model.jnt_qposadr[joint]] - equality_joints.offset(joint)),
        follows={
            model.joint(other).name.removeprefix(prefix): _round(factor)
            for other, factor in equality_joints.factors_of(joint).items()
        },
    )


def _scene(model: Any, base: int, within_m: float) -> Body:
    """Geoms of static bodies near the base, in the base frame."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    inverse_position, inverse_quaternion = np.empty(3), np.empty(4)
    mujoco.mju_negPose(inverse_position, inverse_quaternion, data.xpos[base], data.xquat[base])
    geometries: list[Geometry] = []
    for body in range(model.nbody):
        if model.body_weldid[body] == 0 and model.body_mocapid[body] < 0 and model.body_rootid[body] != base:
            for geom in _visible(model, body):
                if away_m(model, data, geom, data.xpos[base]) > within_m:
                    continue
                in_world = np.empty(4)
                mujoco.mju_mat2Quat(in_world, data.geom_xmat[geom])
                position, quaternion = np.empty(3), np.empty(4)
                mujoco.mju_mulPose(
                    position, quaternion, inverse_position, inverse_quaternion, data.geom_xpos[geom], in_world
                )
                geometries.append(_geometry(model, geom, position, quaternion))
    return Body(name="scene", parent=-1, position_m=_ORIGIN, quaternion=_IDENTITY, geometries=tuple(geometries))


def away_m(model: Any, data: Any, geom: int, point: Any) -> float:
    """Distance from a point in the world to a geom's bounding box or to a plane [m]."""
    offset = data.geom_xmat[geom].reshape(3, 3).T @ (point - data.geom_xpos[geom])
    if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_PLANE):
        return abs(float(offset[2]))
    box = model.geom_aabb[geom]
    return float(np.linalg.norm(np.maximum(np.abs(offset - box[:3]) - box[3:], 0.0)))


def _shapes(model: Any, body: int) -> tuple[Geometry, ...]:
    return tuple(_geometry(model, geom, model.geom_pos[geom], model.geom_quat[geom]) for geom in _visible(model, body))


def _visible(model: Any, body: int) -> list[int]:
    geoms = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
    return [geom for geom in geoms if model.geom_group[geom] <= _LAST_VISIBLE_GROUP and _colour(model, geom)[3] > 0]


def _geometry(model: Any, geom: int, position: Any, quaternion: Any) -> Geometry:
    shape = _SHAPES.get(int(model.geom_type[geom]))
    size = model.geom_size[geom]
    if shape is None:  # a mesh, height field or distance field: its bounding box
        shape, size = "box", model.geom_aabb[geom, 3:]
        centre = np.empty(3)
        mujoco.mju_rotVecQuat(centre, model.geom_aabb[geom, :3], quaternion)
        position = position + centre
    return Geometry(
        shape=shape,
        size_m=_vector(size),
        position_m=_vector(position),
        quaternion=_quaternion(quaternion),
        rgba=_colour(model, geom),
    )


def _colour(model: Any, geom: int) -> Quaternion:
    material = model.geom_matid[geom]
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    return cast("Quaternion", tuple(round(float(value), 3) for value in rgba))


def _name(model: Any, body: int, prefix: str) -> str:
    return str(model.body(body).name.removeprefix(prefix)) or f"body_{body}"


def _vector(values: Any) -> Vector3:
    x, y, z = (_round(value) for value in values)
    return x, y, z


def _quaternion(values: Any) -> Quaternion:
    w, x, y, z = (_round(value) for value in values)
    return w, x, y, z


def _round(value: Any) -> float:
    return round(float(value), _DIGITS) + 0.0  # -0.0 reads as 0

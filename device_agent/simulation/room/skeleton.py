"""Joints of simulated people: the true positions that a skeleton tracker estimates.

The joints are the 20 of Kinect v1 (Microsoft, Kinect for Windows SDK 1.8, ``JointType``), in snake case. Left and right
are those of the person.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from device_agent.ports.sensor import Floats
from device_agent.simulation.room.pedestrian import LIMBS

_TRUNK = ""
_JOINTS: Mapping[str, tuple[str, tuple[float, float, float]]] = {
    "hip_center": (_TRUNK, (0.0, 0.0, 0.06)),
    "spine": (_TRUNK, (0.0, 0.0, 0.25)),
    "shoulder_center": (_TRUNK, (0.0, 0.0, 0.5)),
    "head": (_TRUNK, (0.02, 0.0, 0.71)),
    **{
        f"{joint}_{side}": (f"_{limb}_{side}", offset_m)
        for side in ("left", "right")
        for joint, limb, offset_m in (
            ("shoulder", "arm", (0.0, 0.0, 0.0)),
            ("elbow", "forearm", (0.0, 0.0, 0.0)),
            ("wrist", "forearm", (0.0, 0.0, -0.22)),
            ("hand", "forearm", (0.0, 0.0, -0.28)),
            ("hip", "thigh", (0.0, 0.0, 0.0)),
            ("knee", "shin", (0.0, 0.0, 0.0)),
            ("ankle", "shin", (0.0, 0.0, -0.4)),
            ("foot", "shin", (0.1, 0.0, -0.44)),
        )
    },
}
"""Joint → suffix of the pedestrian's body, and the joint's position in that body's frame [m], by the shapes of the
laboratory's person."""
TRUNK = frozenset(name for name, (limb, _) in _JOINTS.items() if limb == _TRUNK)
"""Joints inside the trunk and the head."""
JOINTS = tuple(_JOINTS)


@dataclass(frozen=True, slots=True)
class Skeleton:
    """One person of a model.

    Attributes:
        name: Name of the person.
        bodies: Its bodies in the model.
        joint_bodies: Body of each joint, shape (20,).
        offsets_m: Position of each joint in its body's frame, shape (20, 3) [m].
    """

    name: str
    bodies: frozenset[int]
    joint_bodies: Any
    offsets_m: Floats

    def positions_m(self, data: Any) -> Floats:
        """Present positions of the ``JOINTS`` in the room, shape (20, 3) [m]."""
        axes = data.xmat[self.joint_bodies].reshape(-1, 3, 3)
        positions: Floats = data.xpos[self.joint_bodies] + np.einsum("nij,nj->ni", axes, self.offsets_m)
        return positions


def find(model: Any) -> tuple[Skeleton, ...]:
    """All people of a model: bodies with the limbs of a pedestrian."""
    bodies = {model.body(index).name: index for index in range(model.nbody)}
    people = [name for name in bodies if name and all(f"{name}_{limb}" in bodies for limb in LIMBS)]
    return tuple(
        Skeleton(
            name=name,
            bodies=frozenset((bodies[name], *(bodies[f"{name}_{limb}"] for limb in LIMBS))),
            joint_bodies=np.array([bodies[f"{name}{limb}"] for limb, _ in _JOINTS.values()], dtype=np.intp),
            offsets_m=np.array([offset_m for _, offset_m in _JOINTS.values()]),
        )
        for name in people
    )

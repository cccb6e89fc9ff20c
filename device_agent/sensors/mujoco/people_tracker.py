"""Tracks people as the skeleton tracker of a depth camera does.

A person is tracked between 0.8 and 4 m (Microsoft, Kinect for Windows SDK 1.8, default range) while the centre of the
hips is in the image and the camera sees at least half of the 20 joints. A ray from the camera decides for each joint:
it is tracked if the ray ends at the person's own surface in front of it, and inferred if something hides it, also
another part of the body. Joints outside of the image are missing.

A tracked joint has the noise of the depth image at its distance. The error of an inferred joint has a standard
deviation of 8 cm in each direction. Both are approximate: Wang, Kurillo, Ofli and Bajcsy, "Evaluation of Pose Tracking
Accuracy in the First and Second Generations of Microsoft Kinect", 2015, compare Kinect v1 with motion capture.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from device_agent.ports.sensor import Floats, rounded
from device_agent.protocol import BodyJoint, TrackedPerson
from device_agent.simulation.room import skeleton
from device_agent.simulation.room.skeleton import Skeleton

NEAREST_M, FURTHEST_M = 0.8, 4.0
INFERRED_M = 0.08
"""Standard deviation of an inferred joint in each direction [m]."""
_FORGOTTEN_S = 1.0
"""A person that is lost for longer gets a new id."""
_LEAST_TRACKED = len(skeleton.JOINTS) // 2
_HOUSING_M = 0.1
"""Distance at which rays start, outside the camera's own housing."""
_COVER_M = (0.13, 0.22)
"""Greatest depth of a visible joint below the person's surface: limbs, and trunk and head [m]."""
_VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
"""Geom groups that MuJoCo draws by default; the others are shapes for contacts only."""
_HIPS = skeleton.JOINTS.index("hip_center")


@dataclass(frozen=True, slots=True)
class CameraPose:
    """Place and view of the camera. ``tangents``: of half of the field of view, horizontal and vertical."""

    position_m: Floats
    rotation: Floats
    tangents: tuple[float, float]

    def project(self, positions_m: Floats) -> tuple[Any, Floats]:
        """Whether each of n positions is in the image, and its depth along the viewing direction [m]."""
        right_m, up_m, behind_m = ((positions_m - self.position_m) @ self.rotation).T
        depth_m: Floats = -behind_m
        wide, high = self.tangents
        return (depth_m > 0) & (np.abs(right_m) <= wide * depth_m) & (np.abs(up_m) <= high * depth_m), depth_m


class PeopleTracker:
    """Tracks the people of one model. Not thread-safe.

    Args:
        model: The compiled model.
        random: Generator of the noise.
        noise_m: Standard deviation of depth at a depth [m].
        own_body: Body of the camera, -1 for none.
    """

    def __init__(
        self, model: Any, *, random: np.random.Generator, noise_m: Callable[[Floats], Floats], own_body: int
    ) -> None:
        self._model = model
        self._random = random
        self._noise_m = noise_m
        self._own_body = own_body
        self._skeletons = skeleton.find(model)
        self._covers_m = np.array([_COVER_M[name in skeleton.TRUNK] for name in skeleton.JOINTS])
        self._seen: dict[str, tuple[int, float]] = {}
        self._last_id = 0

    def track(self, data: Any, pose: CameraPose) -> Sequence[TrackedPerson]:
        """The people that the camera tracks in this state of the world."""
        tracked = [self._track(each, data, pose) for each in self._skeletons]
        return [person for person in tracked if person is not None]

    def _track(self, person: Skeleton, data: Any, pose: CameraPose) -> TrackedPerson | None:
        truth_m = person.positions_m(data)
        inside, depth_m = pose.project(truth_m)
        if not inside[_HIPS] or not NEAREST_M <= depth_m[_HIPS] <= FURTHEST_M:
            return None
        covers = zip(truth_m, self._covers_m, strict=True)
        visible = inside & [self._sees(person, data, pose, joint_m, cover_m) for joint_m, cover_m in covers]
        if visible.sum() < _LEAST_TRACKED:
            return None
        deviation_m = np.where(visible, self._noise_m(depth_m), INFERRED_M)
        measured_m = truth_m + self._random.normal(0.0, 1.0, truth_m.shape) * deviation_m[:, None]
        estimates = zip(skeleton.JOINTS, measured_m, inside, visible, strict=True)
        joints = tuple(
            BodyJoint(name=name, position_m=rounded(position_m), state="tracked" if seen else "inferred")
            for name, position_m, in_image, seen in estimates
            if in_image
        )
        identity = self._identify(person.name, float(data.time))
        return TrackedPerson(id=identity, position_m=rounded(measured_m[_HIPS]), joints=joints)

    def _sees(self, person: Skeleton, data: Any, pose: CameraPose, joint_m: Floats, cover_m: float) -> bool:
        """Whether a ray from the camera reaches the surface of the person in front of the joint."""
        offset_m = joint_m - pose.position_m
        distance_m = float(np.linalg.norm(offset_m))
        direction, geom = offset_m / distance_m, np.full(1, -1, dtype=np.int32)
        start_m = pose.position_m + direction * _HOUSING_M
        reached_m = _HOUSING_M + mujoco.mj_ray(
            self._model, data, start_m, direction, _VISIBLE_GROUPS, True, self._own_body, geom, None
        )  # fmt: skip
        if geom[0] < 0 or reached_m > distance_m:
            return True
        own = int(self._model.geom_bodyid[geom[0]]) in person.bodies
        return own and reached_m >= distance_m - cover_m

    def _identify(self, name: str, now_s: float) -> int:
        """The id of a person that is seen now."""
        identity, seen_s = self._seen.get(name, (0, -np.inf))
        if now_s - seen_s > _FORGOTTEN_S:
            self._last_id += 1
            identity = self._last_id
        self._seen[name] = identity, now_s
        return identity

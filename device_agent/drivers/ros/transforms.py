"""Poses of frames from ``tf``."""

import math

from device_agent.middleware.ros.messages import Quaternion, Transform, Transforms, Vector3

_MAX_DEPTH = 32


class TransformTree:
    """The newest transform of each frame in its parent. Written by one thread, read by any."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Transform, float]] = {}

    def accept(self, message: Transforms, at_s: float, *, static: bool = False) -> None:
        """Use a message that arrived at ``at_s`` [s]. Static transforms never become outdated."""
        for each in message.transforms:
            parent, child = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
            self._parents[child] = (parent, each.transform, math.inf if static else at_s)

    def pose(self, fixed: str, frame: str, newer_than_s: float) -> Transform | None:
        """Pose of ``frame`` in ``fixed``; ``None`` if it is unknown or a part of it is older than this time [s]."""
        pose = Transform(Vector3(0.0, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
        for _ in range(_MAX_DEPTH):
            if frame == fixed:
                return pose
            frame, transform, at_s = self._parents.get(frame, ("", pose, -math.inf))
            if at_s < newer_than_s:
                return None
            pose = _compose(transform, pose)
        return None


def _compose(outer: Transform, inner: Transform) -> Transform:
    q, p = outer.rotation, inner.translation
    # p + 2 w (v × p) + 2 v × (v × p)
    x, y, z = q.y * p.z - q.z * p.y, q.z * p.x - q.x * p.z, q.x * p.y - q.y * p.x
    turned = Vector3(
        p.x + 2 * (q.w * x + q.y * z - q.z * y),
        p.y + 2 * (q.w * y + q.z * x - q.x * z),
        p.z + 2 * (q.w * z + q.x * y - q.y * x),
    )
    t, r = outer.translation, inner.rotation
    return Transform(
        Vector3(t.x + turned.x, t.y + turned.y, t.z + turned.z),
        Quaternion(
            q.w * r.x + q.x * r.w + q.y * r.z - q.z * r.y,
            q.w * r.y - q.x * r.z + q.y * r.w + q.z * r.x,
            q.w * r.z + q.x * r.y - q.y * r.x + q.z * r.w,
            q.w * r.w - q.x * r.x - q.y * r.y - q.z * r.z,
        ),
    )

"""Checks of a driver's measurements: the agent never steers by values that are invalid or outdated."""

import math

from device_agent.ports.driver import Observation, UnreachableError

STALE_S = 1.0
"""A device without new values for longer than this counts as unreachable [s]; the slowest known sends 6 a second."""


def check(observation: Observation, *, joints: int, now_s: float) -> None:
    """Check a measurement at the time ``now_s`` of the monotonic clock [s].

    Raises:
        UnreachableError: A value is missing or not finite, or all are outdated.
    """
    for quantity, values in (
        ("positions", observation.position_rad),
        ("velocities", observation.velocity_rad_s),
        ("efforts", observation.effort_nm),
    ):
        if len(values) != joints:
            raise UnreachableError(f"the device reports {len(values)} {quantity} for {joints} joints")
        if not math.isfinite(sum(values)):
            raise UnreachableError(f"the device reports {quantity} that are not finite")
    if observation.at_s is not None and now_s - observation.at_s > STALE_S:
        raise UnreachableError(f"the device has sent no new values for {now_s - observation.at_s:.1f} s")

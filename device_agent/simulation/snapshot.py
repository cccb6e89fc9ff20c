"""The state of a world at one moment."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """The world after a group of steps. The arrays are read-only copies.

    Attributes:
        time_s: Simulated time [s].
        taken_s: ``time.monotonic()`` of the snapshot [s].
        qpos: Generalised positions, shape (nq,).
        qvel: Generalised velocities, shape (nv,).
        effort: Motor torque or force per degree of freedom including gravity compensation, shape (nv,).
        ctrl: Actuator controls, shape (nu,).
        body_position_m: Body positions in the world, shape (nbody, 3) [m].
        body_quaternion: Body orientations in the world, shape (nbody, 4).
        site_position_m: Site positions in the world, shape (nsite, 3) [m].
        mocap_position_m: Positions of mocap bodies, shape (nmocap, 3) [m].
        mocap_quaternion: Orientations of mocap bodies, shape (nmocap, 4).
        lag_ms: Simulated time lost so far because the machine could not keep up [ms].
        fault: Why the world has stopped; empty while it runs.
    """

    time_s: float
    taken_s: float
    qpos: Floats
    qvel: Floats
    effort: Floats
    ctrl: Floats
    body_position_m: Floats
    body_quaternion: Floats
    site_position_m: Floats
    mocap_position_m: Floats
    mocap_quaternion: Floats
    lag_ms: float
    fault: str
    addresses: Mapping[str, int] = field(repr=False)

    @property
    def position_rad(self) -> dict[str, float]:
        """True position of every hinge [rad] and slide [m] by full joint name."""
        return {name: float(self.qpos[address]) for name, address in self.addresses.items()}


def take(data: Any, *, passive_gravity: Floats, addresses: Mapping[str, int], lag_s: float, fault: str) -> Snapshot:
    """A snapshot of the current state.

    Args:
        data: The world's ``MjData``.
        passive_gravity: Share of gravity compensation to add to the motor effort, per degree of freedom.
        addresses: Full joint name → index in ``qpos``.
        lag_s: Simulated time lost so far [s].
        fault: Why the world has stopped.
    """
    arrays = {
        "qpos": data.qpos,
        "qvel": data.qvel,
        "effort": data.qfrc_actuator + passive_gravity * data.qfrc_gravcomp,
        "ctrl": data.ctrl,
        "body_position_m": data.xpos,
        "body_quaternion": data.xquat,
        "site_position_m": data.site_xpos,
        "mocap_position_m": data.mocap_pos,
        "mocap_quaternion": data.mocap_quat,
    }
    copies = {name: np.array(array) for name, array in arrays.items()}
    for copy in copies.values():
        copy.setflags(write=False)
    return Snapshot(
        time_s=float(data.time),
        taken_s=time.monotonic(),
        lag_ms=lag_s * 1000,
        fault=fault,
        addresses=addresses,
        **copies,
    )

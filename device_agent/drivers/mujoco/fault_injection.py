"""Faults injected into a simulated robot from a file on the agent's machine, for tests and demonstrations.

Only users of the agent's machine can inject faults; no message can. The file may be missing and is read again when it
changes.

```toml
overheating = { elbow = 2.0 }   # no cooling, and additional warming [K/min]
weak = { wrist_1 = 0.3 }        # share of the torque that is left
stuck = ["shoulder_pan"]        # does not move
battery_percent = 25.0          # charge at this moment
charging = true                 # on the charger; false: never, even when empty
```
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from device_agent.protocol.errors import ProtocolError
from device_agent.simulation import fault_file

_CREEP_RAD_S = 1e-4
"""A stuck joint moves at most this fast, by viscous damping; dry friction yields in MuJoCo."""


class InjectedFaults(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Faults of one robot.

    Attributes:
        overheating: Joint → additional warming [K/min]; the joint does not cool.
        weak: Joint → share of its torque that is left, 0…1.
        stuck: Joints that do not move.
        battery_percent: Battery charge to set once, when the file is read.
        charging: Whether the robot is on its charger; by default it charges when the battery is empty.
    """

    overheating: dict[str, Annotated[float, Meta(gt=0, le=100)]] = {}
    weak: dict[str, Annotated[float, Meta(ge=0, le=1)]] = {}
    stuck: tuple[str, ...] = ()
    battery_percent: Annotated[float, Meta(ge=0, le=100)] | None = None
    charging: bool | None = None


NO_FAULTS = InjectedFaults()


def read(text: str, joints: Sequence[str]) -> InjectedFaults:
    """Parse a fault file.

    Raises:
        ProtocolError: Not TOML, or an unknown field or joint; the message lists the valid ones.
    """
    faults = fault_file.read(text, InjectedFaults)
    for name in (*faults.overheating, *faults.weak, *faults.stuck):
        if name not in joints:
            raise ProtocolError(f"no joint '{name}'; valid joints: {', '.join(joints)}")
    return faults


class FaultInjector(fault_file.FaultFile[InjectedFaults]):
    """The fault file of one robot.

    Args:
        path: The file; ``None`` disables fault injection.
        joints: Names of the robot's joints.
    """

    def __init__(self, path: Path | None, joints: Sequence[str]) -> None:
        super().__init__(path, partial(read, joints=tuple(joints)))


class MotorFault:
    """``Process`` that applies joint faults to the model in the world's thread.

    A stuck joint gets a very high damping; a weak one loses torque, also for holding itself.

    Args:
        model: The unmodified ``MjModel``.
        actuators: Joint → its motor.
    """

    def __init__(self, model: Any, actuators: Mapping[str, int]) -> None:
        self._actuators = dict(actuators)
        self._damping = np.array(model.dof_damping)
        self._force = np.array(model.actuator_forcerange)
        self._torque = np.array(model.jnt_actfrcrange)
        self._requested = self._applied = NO_FAULTS

    def set(self, faults: InjectedFaults) -> None:
        """Apply these faults from the next group of steps on. Thread-safe."""
        self._requested = faults

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """See ``Process``."""
        del data, time_s
        requested = self._requested
        if requested is self._applied:
            return
        for name, actuator in self._actuators.items():
            joint, share = model.actuator_trnid[actuator, 0], requested.weak.get(name, 1.0)
            dof, max_nm = model.jnt_dofadr[joint], float(np.abs(self._force[actuator]).max())
            model.dof_damping[dof] = max_nm / _CREEP_RAD_S if name in requested.stuck else self._damping[dof]
            model.actuator_forcerange[actuator] = self._force[actuator] * share
            model.jnt_actfrcrange[joint] = self._torque[joint] * share
        self._applied = requested

"""Faults put into a simulated robot on purpose, for tests and demonstrations: from a file beside the agent.

Only who may write on the agent's own machine can make a robot ill: no message, however signed, does. The file need not
be there; it is read again whenever it has changed.

```toml
overheating = { elbow = 2.0 }   # gives off no heat, and warms by so many kelvin a minute besides
weak = { wrist_1 = 0.3 }        # has this share of its torque left
stuck = ["shoulder_pan"]        # moves no more
battery_percent = 25.0          # this is what it has now
charging = true                 # on its charger, or false: not, however empty
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
"""A stuck joint moves no faster with all the torque of its motor: it stands in something thicker than honey, for dry
friction gives way in MuJoCo."""


class InjectedFaults(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a robot suffers from.

    Attributes:
        overheating: Joint → warming besides that of its work [K/min]; it gives off no heat meanwhile.
        weak: Joint → share of its torque that is left, 0…1.
        stuck: Joints that do not move.
        battery_percent: Charge that the battery is set to, once, when the file is read.
        charging: Whether it is on its charger; else it goes there when it is empty.
    """

    overheating: dict[str, Annotated[float, Meta(gt=0, le=100)]] = {}
    weak: dict[str, Annotated[float, Meta(ge=0, le=1)]] = {}
    stuck: tuple[str, ...] = ()
    battery_percent: Annotated[float, Meta(ge=0, le=100)] | None = None
    charging: bool | None = None


WELL = InjectedFaults()


def read(text: str, joints: Sequence[str]) -> InjectedFaults:
    """Read a file's text.

    Raises:
        ProtocolError: Not TOML, or a field or joint is unknown; the text lists those there are.
    """
    ailments = fault_file.read(text, InjectedFaults)
    for name in (*ailments.overheating, *ailments.weak, *ailments.stuck):
        if name not in joints:
            raise ProtocolError(f"no joint '{name}'; there are: {', '.join(joints)}")
    return ailments


class FaultInjector(fault_file.FaultFile[InjectedFaults]):
    """The file of one robot.

    Args:
        path: Where it may be; ``None``: nowhere.
        joints: Names of the robot's joints.
    """

    def __init__(self, path: Path | None, joints: Sequence[str]) -> None:
        super().__init__(path, partial(read, joints=tuple(joints)))


class MotorFault:
    """What ails joints, in the simulation's own terms: a ``Process``, so that nobody writes beside the world's thread.

    A joint that is stuck hardly moves for all its motor can do; a weak one has less torque, also to hold itself up.

    Args:
        model: ``MjModel``, with every joint as it was made.
        actuators: Joint → its motor.
    """

    def __init__(self, model: Any, actuators: Mapping[str, int]) -> None:
        self._actuators = dict(actuators)
        self._damping = np.array(model.dof_damping)
        self._force = np.array(model.actuator_forcerange)
        self._torque = np.array(model.jnt_actfrcrange)
        self._wanted = self._done = WELL

    def want(self, ailments: InjectedFaults) -> None:
        """From the next group of steps on it is so. Any thread."""
        self._wanted = ailments

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """See ``Process``."""
        del data, time_s
        wanted = self._wanted
        if wanted is self._done:
            return
        for name, actuator in self._actuators.items():
            joint, left = model.actuator_trnid[actuator, 0], wanted.weak.get(name, 1.0)
            dof, most_nm = model.jnt_dofadr[joint], float(np.abs(self._force[actuator]).max())
            model.dof_damping[dof] = most_nm / _CREEP_RAD_S if name in wanted.stuck else self._damping[dof]
            model.actuator_forcerange[actuator] = self._force[actuator] * left
            model.jnt_actfrcrange[joint] = self._torque[joint] * left
        self._done = wanted

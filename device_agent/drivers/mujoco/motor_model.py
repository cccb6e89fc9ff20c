"""How a simulated robot feels: temperature and load of its motors, its battery, and faults put into it on purpose.

All figures are approximate and of no particular motor; what counts is that they move as real ones do. A motor at its
largest torque turns, as a direct current motor that is held still does, the power ``max_effort * max_velocity`` into
heat; less torque heats with its square. The joint warms and cools like one body (first order) in a room of 22 °C.
"""

import math
import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from device_agent.drivers.mujoco.fault_injection import InjectedFaults
from device_agent.protocol import Joint
from device_agent.protocol.manifests.capabilities import Battery
from device_agent.simulation.snapshot import Floats

HEALTH = "health"
"""The stream."""

AMBIENT_C = 22.0
IDLE_RISE_C = 8.0
"""How much warmer than the room a joint is that is switched on and rests."""
FULL_RISE_C = 160.0
"""How much warmer still it would become at its largest torque without end."""
WARMING_S = 900.0
"""Time in which it has come 63 % of the way to where its temperature rests."""
LOAD_S = 5.0
"""Time over which the load is taken."""
_STEP_S = 0.2
_LONGEST_STEP_S = 60.0
_NOISE_C = 0.1

STALLED_S = 0.5
"""A motor at its limit that has not moved for so long is stuck;"""
_STILL_RAD_S = 0.02
_AT_LIMIT = 0.97
_BEHIND_RAD = 0.1
"""so far from where it should be."""

PLUGGED_IN_PERCENT = 5.0
"""At this charge a simulated robot is put on its charger until it is full: it shows the warnings before, and is not
dead when somebody looks at it a day later."""
_CHARGING_S = 7200.0
_INNER_OHM = 0.05


class BatteryModel:
    """Charge and voltage.

    Args:
        battery: The robot type's.
    """

    def __init__(self, battery: Battery) -> None:
        self._battery = battery
        self._left_wh = battery.capacity_wh
        self._power_w = battery.idle_w
        self._plugged_in = False
        self.forced: bool | None = None

    @property
    def percent(self) -> float:
        """Charge, 0…100."""
        return 100.0 * self._left_wh / self._battery.capacity_wh

    @percent.setter
    def percent(self, value: float) -> None:
        self._left_wh = self._battery.capacity_wh * min(max(value, 0.0), 100.0) / 100.0

    @property
    def charging(self) -> bool:
        """Whether it is on its charger."""
        return self._plugged_in if self.forced is None else self.forced

    def take(self, motors_w: float, duration_s: float) -> None:
        """Time goes on, with so much power for the motors."""
        battery = self._battery
        self._power_w = battery.idle_w + motors_w
        gained_w = battery.capacity_wh * 3600 / _CHARGING_S if self.charging else -self._power_w
        self._left_wh = min(max(self._left_wh + gained_w * duration_s / 3600, 0.0), battery.capacity_wh)
        if self.percent <= PLUGGED_IN_PERCENT:
            self._plugged_in = True
        elif self._left_wh >= battery.capacity_wh:
            self._plugged_in = False

    def values(self) -> dict[str, float | bool]:
        """As the stream tells it."""
        battery = self._battery
        open_v = battery.empty_v + (battery.full_v - battery.empty_v) * self.percent / 100.0
        drop_v = 0.0 if self.charging else self._power_w / open_v * _INNER_OHM
        return {
            "battery_percent": round(self.percent, 2),
            "battery_v": round(open_v - drop_v, 2),
            "charging": self.charging,
        }


class Health:
    """One robot's. ``observe`` is the control loop's; everything else may be called from another thread.

    Args:
        joints: The robot type's.
        battery: Where it has one.
        seed: Of the sensors' noise: the device's name.
    """

    def __init__(self, joints: Sequence[Joint], battery: Battery | None, *, seed: str = "") -> None:
        self._names = [joint.name for joint in joints]
        self._most_nm = np.array([joint.max_effort_nm for joint in joints])
        self._fastest_rad_s = np.array([joint.max_velocity_rad_s for joint in joints])
        count = len(joints)
        self._temperature_c = np.full(count, AMBIENT_C + IDLE_RISE_C)
        self._load_2 = np.zeros(count)
        self._heat_2 = np.zeros(count)
        self._work_j = 0.0
        self._open_s = 0.0
        self._time_s = math.nan
        self._ailing = np.zeros(count)
        self._still_s = np.zeros(count)
        self._battery = None if battery is None else BatteryModel(battery)
        self._noise = np.random.default_rng(zlib.crc32(seed.encode()))

    def suffer(self, ailments: InjectedFaults) -> None:
        """Put faults into it; those of before are healed."""
        self._ailing = np.array([ailments.overheating.get(name, 0.0) / 60 for name in self._names])
        if self._battery is not None:
            self._battery.forced = ailments.charging
            if ailments.battery_percent is not None:
                self._battery.percent = ailments.battery_percent

    def observe(self, time_s: float, effort_nm: Floats, velocity_rad_s: Floats, *, power_w: float = 0.0) -> None:
        """Time has come to ``time_s``, with this effort and motion since last time. Quick.

        Args:
            time_s: Simulated [s].
            effort_nm: Torque of the joints' motors, shape (n,).
            velocity_rad_s: Of the joints, shape (n,).
            power_w: What other motors take.
        """
        elapsed_s = time_s - self._time_s
        self._time_s = time_s
        if not 0 < elapsed_s < _LONGEST_STEP_S:  # the first time, or the world stood still meanwhile
            return
        load_2 = (effort_nm / self._most_nm) ** 2
        self._load_2 += (load_2 - self._load_2) * min(1.0, elapsed_s / LOAD_S)
        self._heat_2 += load_2 * elapsed_s
        self._work_j += (float(np.abs(effort_nm * velocity_rad_s).sum()) + power_w) * elapsed_s
        self._open_s += elapsed_s
        if self._open_s >= _STEP_S:
            self._warm(self._heat_2 / self._open_s, self._open_s)
            self._heat_2, self._work_j, self._open_s = np.zeros(len(self._names)), 0.0, 0.0

    def stuck(self, elapsed_s: float, behind_rad: Floats, effort_nm: Floats, velocity_rad_s: Floats) -> list[str]:
        """Names of joints whose motors give all they can and have not moved for half a second, though they should.

        Args:
            elapsed_s: Since last time [s].
            behind_rad: From where they are to where they should be, shape (n,).
            effort_nm: Torque of their motors, shape (n,).
            velocity_rad_s: Of the joints, shape (n,).
        """
        strained = np.abs(effort_nm) >= _AT_LIMIT * self._most_nm
        if not strained.any():
            self._still_s[:] = 0.0
            return []
        stalled = strained & (np.abs(velocity_rad_s) < _STILL_RAD_S) & (np.abs(behind_rad) > _BEHIND_RAD)
        self._still_s = np.where(stalled, self._still_s + elapsed_s, 0.0)
        return [self._names[index] for index in np.flatnonzero(self._still_s > STALLED_S - 1e-6)]

    def forgive(self) -> None:
        """Whoever was stuck may try again."""
        self._still_s = np.zeros(len(self._names))

    def values(self) -> Mapping[str, float | bool]:
        """As the stream ``health`` tells it."""
        temperature = self._temperature_c + self._noise.normal(0.0, _NOISE_C, len(self._names))
        load = np.sqrt(np.maximum(self._load_2, 0.0))
        found: dict[str, float | bool] = {}
        for name, warm, share in zip(self._names, temperature.tolist(), load.tolist(), strict=True):
            found[f"temperature_c.{name}"] = round(warm, 2)
            found[f"load.{name}"] = round(share, 3)
        return found if self._battery is None else found | self._battery.values()

    def _warm(self, load_2: Floats, duration_s: float) -> None:
        """A joint that overheats gives off no heat any more, and takes up what it was told to."""
        heat = (IDLE_RISE_C + FULL_RISE_C * load_2) / WARMING_S
        cooling = np.where(self._ailing > 0, 0.0, (self._temperature_c - AMBIENT_C) / WARMING_S)
        self._temperature_c = self._temperature_c + (heat + self._ailing - cooling) * duration_s
        if self._battery is not None:
            lost_w = float((load_2 * self._most_nm * self._fastest_rad_s).sum())
            self._battery.take(self._work_j / duration_s + lost_w, duration_s)

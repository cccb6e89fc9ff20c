"""Simulated motor temperature and load, battery, and their injected faults.

All figures are approximate and of no particular motor. A motor at its largest torque dissipates
``max_effort * max_velocity``, like a stalled DC motor; less torque heats with its square. Each joint is a first-order
thermal model in a room of 22 °C.
"""

import math
import zlib
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from device_agent.drivers.mujoco.fault_injection import InjectedFaults
from device_agent.protocol import Joint
from device_agent.protocol.manifests.capabilities import Battery
from device_agent.simulation.snapshot import Floats

HEALTH = "health"
"""Stream name."""

AMBIENT_C = 22.0
IDLE_RISE_C = 8.0
"""Temperature rise of a resting joint that is switched on."""
FULL_RISE_C = 160.0
"""Additional rise at continuous full torque."""
WARMING_S = 900.0
"""Thermal time constant."""
LOAD_S = 5.0
"""Averaging time of the load."""
_STEP_S = 0.2
_LONGEST_STEP_S = 60.0
_NOISE_C = 0.1

STALLED_S = 0.5
"""A motor at its limit counts as stalled after this time without motion."""
_STILL_RAD_S = 0.02
_AT_LIMIT = 0.97
_BEHIND_RAD = 0.1
"""Smallest position error of a stalled joint."""

PLUGGED_IN_PERCENT = 5.0
"""At this charge a simulated robot is put on its charger until it is full: low-charge warnings appear, but the robot
never runs empty."""
_CHARGING_S = 7200.0
_INNER_OHM = 0.05


class BatteryModel:
    """Battery charge and voltage.

    Args:
        battery: The robot type's battery.
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
        """Whether the robot is on its charger."""
        return self._plugged_in if self.forced is None else self.forced

    def advance(self, motors_w: float, duration_s: float) -> None:
        """Advance by ``duration_s`` with this motor power."""
        battery = self._battery
        self._power_w = battery.idle_w + motors_w
        gained_w = battery.capacity_wh * 3600 / _CHARGING_S if self.charging else -self._power_w
        self._left_wh = min(max(self._left_wh + gained_w * duration_s / 3600, 0.0), battery.capacity_wh)
        if self.percent <= PLUGGED_IN_PERCENT:
            self._plugged_in = True
        elif self._left_wh >= battery.capacity_wh:
            self._plugged_in = False

    def values(self) -> dict[str, float | bool]:
        """Values of the stream."""
        battery = self._battery
        open_v = battery.empty_v + (battery.full_v - battery.empty_v) * self.percent / 100.0
        drop_v = 0.0 if self.charging else self._power_w / open_v * _INNER_OHM
        return {
            "battery_percent": round(self.percent, 2),
            "battery_v": round(open_v - drop_v, 2),
            "charging": self.charging,
        }


class MotorModel:
    """Motor state of one robot. The control loop calls ``observe``; other threads may call everything else.

    Args:
        joints: The robot type's joints.
        battery: The robot type's battery, if any.
        seed: Seed of the sensor noise: the device's name.
        grips: Joints of fingers, which may stop at an object: they never count as stalled.
    """

    def __init__(
        self, joints: Sequence[Joint], battery: Battery | None, *, seed: str = "", grips: Collection[str] = ()
    ) -> None:
        self._names = [joint.name for joint in joints]
        self._may_stall = np.array([joint.name not in grips for joint in joints], dtype=np.bool_)
        self._max_nm = np.array([joint.max_effort_nm for joint in joints])
        self._fastest_rad_s = np.array([joint.max_velocity_rad_s for joint in joints])
        count = len(joints)
        self._temperature_c = np.full(count, AMBIENT_C + IDLE_RISE_C)
        self._load_2 = np.zeros(count)
        self._heat_2 = np.zeros(count)
        self._work_j = 0.0
        self._pending_s = 0.0
        self._time_s = math.nan
        self._overheating = np.zeros(count)
        self._still_s = np.zeros(count)
        self._battery = None if battery is None else BatteryModel(battery)
        self._noise = np.random.default_rng(zlib.crc32(seed.encode()))

    def inject(self, faults: InjectedFaults) -> None:
        """Replace the injected faults."""
        self._overheating = np.array([faults.overheating.get(name, 0.0) / 60 for name in self._names])
        if self._battery is not None:
            self._battery.forced = faults.charging
            if faults.battery_percent is not None:
                self._battery.percent = faults.battery_percent

    def observe(self, time_s: float, effort_nm: Floats, velocity_rad_s: Floats, *, power_w: float = 0.0) -> None:
        """Advance to ``time_s``. Takes microseconds.

        Args:
            time_s: Simulated time [s].
            effort_nm: Torque of the joints' motors, shape (n,).
            velocity_rad_s: Joint velocities, shape (n,).
            power_w: Power of other motors.
        """
        elapsed_s = time_s - self._time_s
        self._time_s = time_s
        if not 0 < elapsed_s < _LONGEST_STEP_S:  # first call, or the world was stopped
            return
        load_2 = (effort_nm / self._max_nm) ** 2
        self._load_2 += (load_2 - self._load_2) * min(1.0, elapsed_s / LOAD_S)
        self._heat_2 += load_2 * elapsed_s
        self._work_j += (float(np.abs(effort_nm * velocity_rad_s).sum()) + power_w) * elapsed_s
        self._pending_s += elapsed_s
        if self._pending_s >= _STEP_S:
            self._warm(self._heat_2 / self._pending_s, self._pending_s)
            self._heat_2, self._work_j, self._pending_s = np.zeros(len(self._names)), 0.0, 0.0

    def stalled(self, elapsed_s: float, behind_rad: Floats, effort_nm: Floats, velocity_rad_s: Floats) -> list[str]:
        """Names of the joints that have stalled at full torque for 0.5 s.

        Args:
            elapsed_s: Time since the last call [s].
            behind_rad: Position error of each joint, shape (n,).
            effort_nm: Torque of the joints' motors, shape (n,).
            velocity_rad_s: Joint velocities, shape (n,).
        """
        at_limit = self._may_stall & (np.abs(effort_nm) >= _AT_LIMIT * self._max_nm)
        if not at_limit.any():
            self._still_s[:] = 0.0
            return []
        stalled = at_limit & (np.abs(velocity_rad_s) < _STILL_RAD_S) & (np.abs(behind_rad) > _BEHIND_RAD)
        self._still_s = np.where(stalled, self._still_s + elapsed_s, 0.0)
        return [self._names[index] for index in np.flatnonzero(self._still_s > STALLED_S - 1e-6)]

    def clear(self) -> None:
        """Clear stalled joints, so that they may move again."""
        self._still_s = np.zeros(len(self._names))

    def values(self) -> Mapping[str, float | bool]:
        """Values of the stream ``health``."""
        temperature = self._temperature_c + self._noise.normal(0.0, _NOISE_C, len(self._names))
        load = np.sqrt(np.maximum(self._load_2, 0.0))
        values: dict[str, float | bool] = {}
        for name, celsius, share in zip(self._names, temperature.tolist(), load.tolist(), strict=True):
            values[f"temperature_c.{name}"] = round(celsius, 2)
            values[f"load.{name}"] = round(share, 3)
        return values if self._battery is None else values | self._battery.values()

    def _warm(self, load_2: Floats, duration_s: float) -> None:
        """Update temperatures; an overheating joint does not cool and warms at the injected rate."""
        heat = (IDLE_RISE_C + FULL_RISE_C * load_2) / WARMING_S
        cooling = np.where(self._overheating > 0, 0.0, (self._temperature_c - AMBIENT_C) / WARMING_S)
        self._temperature_c = self._temperature_c + (heat + self._overheating - cooling) * duration_s
        if self._battery is not None:
            heat_w = float((load_2 * self._max_nm * self._fastest_rad_s).sum())
            self._battery.advance(self._work_j / duration_s + heat_w, duration_s)

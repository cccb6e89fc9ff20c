"""Air model of a simulated room: heat, carbon dioxide and humidity of one well-mixed volume.

With V the room volume [m³], Q the air exchange with the outside, Q_d that through the open door [m³/s], n people in
the room and k the volumetric heat capacity of air:

- heat [W], first law for a lumped room:
  C dT/dt = 75 n + P_lamp + P_sun + P_heater - (U + k Q) (T - T_outside) - k Q_d (T - T_corridor)
- carbon dioxide, balance of a well-mixed room (as in ASHRAE Standard 62.1, appendix on CO2, and ASTM D6245):
  V dx/dt = 18 l/h n + Q (x_outside - x) + Q_d (x_corridor - x)
- water: V dw/dt = 50 g/h n + Q (w_outside - w) + Q_d (w_corridor - w); relative humidity by the Magnus formula.

For a person who stands or walks slowly, ASHRAE (Fundamentals, nonresidential loads) and ISO 7730 give about 75 W of
sensible heat and 50 g/h of water, ASTM D6245 about 18 l/h of CO2; all rounded and approximate. The radiator follows
its thermostat proportionally and is fully open 1 K below the setpoint.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

from device_agent.protocol.manifests.room import Room
from device_agent.simulation.room.openings import opening
from device_agent.simulation.room.pedestrian import Pedestrian
from device_agent.simulation.world import World

PERIOD_S = 0.5
HEAT_W = 75.0
CO2_M3_S = 0.018 / 3600
WATER_G_S = 50.0 / 3600
AIR_J_M3_K = 1.2 * 1006.0
"""Density times specific heat of air at 20 °C."""
_LAMP_W = 70.0
_SUN_W = 250.0
"""Through the window with open blinds on a bright day; approximate."""
_CORRIDOR_HUMIDITY_PERCENT = 45.0
_BAND_K = 1.0
_PPM = 1e6
_LAMP, _THERMOSTAT, _DOOR, _BLINDS = "lamp", "thermostat", "door", "blinds"
"""Settings and joints that the model reads. A missing one counts as off or shut."""


class Climate:
    """``Process`` that computes ``temperature_c``, ``humidity_percent`` and ``co2_ppm``.

    Args:
        room: Its size and climate parameters.
        world: Receives the quantities.
        people: Pedestrians who may be in the room.
        speedup: Factor by which the air changes faster than simulated time, for tests and demonstrations.
    """

    def __init__(self, room: Room, world: World, people: Sequence[Pedestrian], *, speedup: float = 1.0) -> None:
        self._plan, self._parameters = room.plan, room.climate
        self._world = world
        self._people = people
        self._speedup = speedup
        width, depth = (upper - lower for lower, upper in zip(room.plan.lower_m, room.plan.upper_m, strict=True))
        self._volume_m3 = width * depth * room.plan.height_m
        self._time_s = 0.0
        self._temperature_c = self._parameters.start_c
        self._co2 = self._parameters.start_co2_ppm / _PPM
        self._water_g_m3 = water_g_m3(self._parameters.start_c, self._parameters.start_humidity_percent)
        self._publish()

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Advance to ``time_s`` in steps of 0.5 s."""
        if time_s < self._time_s + PERIOD_S:
            return
        elapsed_s, self._time_s = time_s - self._time_s, time_s
        self._advance(
            elapsed_s * self._speedup,
            door=opening(model, data, _DOOR),
            blinds=opening(model, data, _BLINDS, missing=1.0),
        )
        self._publish()

    def _advance(self, elapsed_s: float, *, door: float, blinds: float) -> None:
        parameters, settings = self._parameters, self._world.settings
        people = sum(self._inside(*person.position_m) for person in self._people)
        fresh_m3_s = parameters.ventilation_per_h * self._volume_m3 / 3600
        through_door_m3_s = parameters.door_m3_h / 3600 * door
        heater = min(1.0, max(0.0, (settings.get(_THERMOSTAT, -math.inf) - self._temperature_c) / _BAND_K))
        gain_w = HEAT_W * people + _LAMP_W * settings.get(_LAMP, 0.0) + _SUN_W * blinds + parameters.heater_w * heater
        to_outside_w_k = parameters.loss_w_k + AIR_J_M3_K * fresh_m3_s
        to_corridor_w_k = AIR_J_M3_K * through_door_m3_s
        self._temperature_c = _first_order(
            self._temperature_c,
            gain=gain_w + to_outside_w_k * parameters.outside_c + to_corridor_w_k * parameters.corridor_c,
            loss=to_outside_w_k + to_corridor_w_k,
            capacity=parameters.capacity_j_k,
            elapsed_s=elapsed_s,
        )
        exchanged = partial(
            _first_order, loss=fresh_m3_s + through_door_m3_s, capacity=self._volume_m3, elapsed_s=elapsed_s
        )
        co2_ppm_m3_s = fresh_m3_s * parameters.outside_co2_ppm + through_door_m3_s * parameters.corridor_co2_ppm
        self._co2 = exchanged(self._co2, gain=CO2_M3_S * people + co2_ppm_m3_s / _PPM)
        outside_g_m3 = water_g_m3(parameters.outside_c, parameters.outside_humidity_percent)
        corridor_g_m3 = water_g_m3(parameters.corridor_c, _CORRIDOR_HUMIDITY_PERCENT)
        water_g_s = fresh_m3_s * outside_g_m3 + through_door_m3_s * corridor_g_m3
        self._water_g_m3 = exchanged(self._water_g_m3, gain=WATER_G_S * people + water_g_s)

    def _inside(self, x_m: float, y_m: float) -> bool:
        (x_lower, y_lower), (x_upper, y_upper) = self._plan.lower_m, self._plan.upper_m
        return x_lower <= x_m <= x_upper and y_lower <= y_m <= y_upper

    def _publish(self) -> None:
        saturated_g_m3 = water_g_m3(self._temperature_c, 100.0)
        self._world.set_quantities(
            {
                "temperature_c": self._temperature_c,
                "humidity_percent": min(100.0, 100.0 * self._water_g_m3 / saturated_g_m3),
                "co2_ppm": self._co2 * _PPM,
            }
        )


def water_g_m3(temperature_c: float, humidity_percent: float) -> float:
    """Water content of air [g/m³]: Magnus formula, Sonntag's coefficients (1990), and the ideal gas law."""
    saturation_pa = 611.2 * math.exp(17.62 * temperature_c / (243.12 + temperature_c))
    return humidity_percent / 100 * saturation_pa / (461.5 * (temperature_c + 273.15)) * 1000


def _first_order(value: float, *, gain: float, loss: float, capacity: float, elapsed_s: float) -> float:
    """Exact solution of capacity dv/dt = gain - loss v for constant gain and loss."""
    if loss <= 0:
        return value + gain / capacity * elapsed_s
    settled = gain / loss
    return settled + (value - settled) * math.exp(-loss / capacity * elapsed_s)

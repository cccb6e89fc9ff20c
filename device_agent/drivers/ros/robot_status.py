"""Everything but joints that a robot reports: battery, diagnostics, safety topics and the pose of its base."""

import json
import math
import time
from collections.abc import Mapping
from typing import Any

from device_agent.drivers.ros.options import Options, Safety
from device_agent.drivers.ros.transforms import TransformTree
from device_agent.middleware.ros import messages, scans
from device_agent.ports.driver import DriverFault

_ERROR = 2
_CHARGING = 1
_STALE_S = 1.0
"""An older pose of the base, or an older scan, is not reported [s]."""
_MAX_SHOWN = 3
_MAX_ERRORS = 50


class RobotStatus:
    """The newest values. Written by one thread, read by any.

    Args:
        options: Which topics carry what.
    """

    def __init__(self, options: Options) -> None:
        self._safety = options.safety
        self._stopping = options.stopping_diagnostics
        self._base = options.base
        self._states: dict[Safety, Any] = {}
        self._errors: dict[str, str] = {}
        self._battery: Mapping[str, float | bool] = {}
        self._odometry: Mapping[str, float] = {}
        self._odometry_s = -math.inf
        self._scans: dict[str, tuple[Mapping[str, float], float]] = {}
        self.transforms = TransformTree()

    # ------------------------------------------------------------ received

    def accept_battery(self, message: messages.BatteryState, at_s: float) -> None:
        """Use a battery state. Unknown values are not finite in ROS."""
        del at_s
        values: dict[str, float | bool] = {"charging": message.power_supply_status == _CHARGING}
        if message.percentage is not None:
            values["battery_percent"] = round(100 * message.percentage, 2)
        if message.voltage is not None:
            values["battery_v"] = message.voltage
        self._battery = values

    def accept_diagnostics(self, message: messages.DiagnosticArray, at_s: float) -> None:
        """Keep the errors. An error ends when its part reports another level."""
        del at_s
        errors = dict(self._errors)
        for status in message.status:
            errors.pop(status.name, None)
            if status.level >= _ERROR and len(errors) < _MAX_ERRORS:
                errors[status.name] = status.message
        self._errors = errors

    def accept_safety(self, safety: Safety, message: Mapping[str, Any], at_s: float) -> None:
        """Use a message of a safety topic.

        Raises:
            ValueError: The message lacks the field.
        """
        del at_s
        self._states = {**self._states, safety: messages.value_of(message, safety.field)}

    def accept_odometry(self, message: messages.Odometry, at_s: float) -> None:
        """Use an odometry."""
        pose, twist = message.pose.pose, message.twist.twist
        self._odometry = {
            "x_m": pose.position.x,
            "y_m": pose.position.y,
            "yaw_rad": yaw(pose.orientation),
            "forward_m_s": twist.linear.x,
            "left_m_s": twist.linear.y,
            "turn_rad_s": twist.angular.z,
        }
        self._odometry_s = at_s

    def accept_scan(self, stream: str, message: scans.LaserScan, at_s: float) -> None:
        """Use a scan.

        Raises:
            ValueError: It is invalid.
        """
        self._scans = {**self._scans, stream: (scans.sectors(message), at_s)}

    # ------------------------------------------------------------ read

    @property
    def silent_safety_topic(self) -> str:
        """A safety topic without a message since the connection; empty if there is none."""
        return next((safety.topic for safety in self._safety if safety not in self._states), "")

    def faults(self) -> tuple[DriverFault, ...]:
        """The present faults."""
        faults = []
        for safety, value in self._states.items():
            # ``True`` equals 1, but a message with another type must not count as normal.
            if not any(value == normal and type(value) is type(normal) for normal in safety.normal):
                text = f"{safety.topic}: '{safety.field}' is {json.dumps(value)[:80]}; release the robot there"
                faults.append(DriverFault("safety", text))
        for stops in (True, False):
            shown = [
                f"{name}: {text}" for name, text in self._errors.items() if name.startswith(self._stopping) is stops
            ]
            if shown:
                more = f" (and {len(shown) - _MAX_SHOWN} more)" if len(shown) > _MAX_SHOWN else ""
                code = "diagnostics-stop" if stops else "diagnostics"
                faults.append(DriverFault(code, "; ".join(shown[:_MAX_SHOWN]) + more, stops=stops))
        return tuple(faults)

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """Values of the streams ``health`` and ``odometry``, and of scans."""
        if stream == "health":
            return self._battery
        newer_than_s = time.monotonic() - _STALE_S
        if stream in self._scans:
            values, at_s = self._scans[stream]
            return values if at_s > newer_than_s else {}
        return self._pose(newer_than_s) if stream == "odometry" else {}

    def _pose(self, newer_than_s: float) -> Mapping[str, float]:
        odometry = self._odometry if self._odometry_s > newer_than_s else {}
        if self._base is None or not self._base.fixed_frame:
            return odometry
        pose = self.transforms.pose(self._base.fixed_frame, self._base.base_frame, newer_than_s)
        if pose is None:
            return {}
        located = {"x_m": pose.translation.x, "y_m": pose.translation.y, "yaw_rad": yaw(pose.rotation)}
        return {**odometry, **located}


def yaw(q: messages.Quaternion) -> float:
    """Rotation about the vertical axis [rad]."""
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))

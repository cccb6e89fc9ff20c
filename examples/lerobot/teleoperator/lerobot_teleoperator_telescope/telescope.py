"""A device of Telescope as a teleoperator."""

from functools import cached_property
from typing import Any

from lerobot.teleoperators import Teleoperator
from lerobot_robot_telescope.client import Device
from lerobot_robot_telescope.units import Units

from .config_telescope import TelescopeTeleoperatorConfig


class TelescopeTeleoperator(Teleoperator):
    """Reads the joints of a device, for example one that an operator moves in the console. It needs no lease."""

    config_class = TelescopeTeleoperatorConfig
    name = "telescope"

    def __init__(self, config: TelescopeTeleoperatorConfig) -> None:
        super().__init__(config)
        self.config = config
        self._device = Device(config.url, config.device)

    @cached_property
    def _units(self) -> Units:
        return Units(self._device.joints(), self.config.gripper)

    @property
    def action_features(self) -> dict[str, type]:
        """Joints; degrees, and percent of the gripper. Asks Telescope at the first use."""
        return self._units.features

    @property
    def feedback_features(self) -> dict[str, type]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether telemetry is received."""
        return self._device.connected

    @property
    def is_calibrated(self) -> bool:
        """Always: the device is calibrated at its agent."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Receive telemetry.

        Raises:
            TelescopeError: The device is offline.
        """
        del calibrate
        self._device.close()
        self._device.watch()

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def get_action(self) -> dict[str, Any]:
        """Measured positions.

        Raises:
            TelescopeError: There is no telemetry, or it is older than 1 s.
        """
        return self._units.to_lerobot(self._device.position_rad())

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing to do: the device feels no forces."""

    def disconnect(self) -> None:
        """End the connection."""
        self._device.close()

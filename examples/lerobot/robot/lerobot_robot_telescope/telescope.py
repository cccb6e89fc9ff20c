"""A device of Telescope as a robot."""

from functools import cached_property
from typing import Any

from lerobot.robots import Robot

from .client import Device
from .config_telescope import TelescopeRobotConfig
from .units import Units


class TelescopeRobot(Robot):
    """Moves a device with a lease. Limits, Stop and the lease are enforced by the device's agent.

    The agent holds the robot 300 ms after the last action. Then it accepts none until ``connect`` is called again.
    """

    config_class = TelescopeRobotConfig
    name = "telescope"

    def __init__(self, config: TelescopeRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self._device = Device(config.url, config.device)

    @cached_property
    def _units(self) -> Units:
        return Units(self._device.joints(), self.config.gripper)

    @property
    def observation_features(self) -> dict[str, type]:
        """Joints; degrees, and percent of the gripper. Asks Telescope at the first use."""
        return self._units.features

    @property
    def action_features(self) -> dict[str, type]:
        """As the observation."""
        return self._units.features

    @property
    def is_connected(self) -> bool:
        """Whether telemetry is received."""
        return self._device.connected

    @property
    def is_calibrated(self) -> bool:
        """Always: the device is calibrated at its agent."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Receive telemetry and take the lease.

        Raises:
            TelescopeError: The device is offline, or another operator has control.
        """
        del calibrate
        self._device.close()
        self._device.watch()
        try:
            self._device.take_control()
        except ConnectionError:
            self._device.close()
            raise

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def get_observation(self) -> dict[str, Any]:
        """Measured positions.

        Raises:
            TelescopeError: There is no telemetry, or it is older than 1 s.
        """
        return self._units.to_lerobot(self._device.position_rad())

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Move the named joints; returns the positions of these joints that the device commands now.

        They differ from ``action`` while the joints are on their way, and if limits changed it.

        Raises:
            TelescopeError: There is no lease, the device holds, or does not accept the action.
            ValueError: A name is not a joint, or a value is not finite.
        """
        commanded_rad = self._device.move(self._units.to_rad(action))
        commanded = self._units.to_lerobot(commanded_rad)
        return {name: commanded[name] for name in action}

    def disconnect(self) -> None:
        """Release the lease. The device holds."""
        self._device.close()

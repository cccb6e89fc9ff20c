"""Configuration of a device of Telescope as a teleoperator."""

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("telescope")
@dataclass
class TelescopeTeleoperatorConfig(TeleoperatorConfig):
    """Names the device. The API key is in the environment variable ``TELESCOPE_TOKEN``, so it is never stored.

    Attributes:
        device: Name of the device.
        url: Address of Telescope.
        gripper: Joint that LeRobot sees in percent of its range; the others are in degrees.
    """

    device: str
    url: str = "http://127.0.0.1:8080"
    gripper: str = "gripper"

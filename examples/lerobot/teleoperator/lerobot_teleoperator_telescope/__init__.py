"""A device of Telescope as a LeRobot teleoperator: ``--teleop.type=telescope``."""

from .config_telescope import TelescopeTeleoperatorConfig
from .telescope import TelescopeTeleoperator

__all__ = ["TelescopeTeleoperator", "TelescopeTeleoperatorConfig"]

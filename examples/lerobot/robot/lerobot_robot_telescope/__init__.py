"""A device of Telescope as a LeRobot robot: ``--robot.type=telescope``."""

from .config_telescope import TelescopeRobotConfig
from .telescope import TelescopeRobot

__all__ = ["TelescopeRobot", "TelescopeRobotConfig"]

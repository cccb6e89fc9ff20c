"""The robots of LeRobot that the driver knows, and the registers of their servos."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

TICKS = 4096
"""Ticks of a turn, of all these servos."""


@dataclass(frozen=True, slots=True)
class Servos:
    """A family of servos, with LeRobot's names of the registers.

    Attributes:
        error_register: Register with the errors.
        error_names: Bit → what it means.
        voltage_register: Register with the voltage [0.1 V].
        speed_register: Register that limits the speed of a position servo.
        speed_unit_rad_s: Unit of this register [rad/s].
    """

    error_register: str
    error_names: Mapping[int, str]
    voltage_register: str
    speed_register: str
    speed_unit_rad_s: float

    def errors(self, bits: int) -> tuple[str, ...]:
        """Names of the errors."""
        return tuple(self.error_names.get(bit, f"error {bit}") for bit in range(8) if bits >> bit & 1)

    def speed(self, velocity_rad_s: float) -> int:
        """The value of the speed register for a highest velocity [rad/s]."""
        return math.ceil(velocity_rad_s / self.speed_unit_rad_s)


@dataclass(frozen=True, slots=True)
class RobotClass:
    """One class of LeRobot.

    Attributes:
        module: Module of the class.
        name: Name of the class.
        servos: Family of its servos.
    """

    module: str
    name: str
    servos: Servos


FEETECH = Servos(
    error_register="Status",
    error_names={0: "voltage", 1: "encoder", 2: "temperature", 3: "current", 5: "overload"},
    voltage_register="Present_Voltage",
    speed_register="Goal_Velocity",
    speed_unit_rad_s=math.tau / TICKS,
)
"""Source: Feetech, memory table of the STS3215."""
DYNAMIXEL = Servos(
    error_register="Hardware_Error_Status",
    error_names={0: "voltage", 2: "temperature", 3: "encoder", 4: "electrical shock", 5: "overload"},
    voltage_register="Present_Input_Voltage",
    speed_register="Profile_Velocity",
    speed_unit_rad_s=0.229 * math.tau / 60,
)
"""Source: ROBOTIS e-Manual, control tables of XL430-W250 and XL330-M288."""

ROBOTS: Mapping[str, RobotClass] = {
    "koch_follower": RobotClass("lerobot.robots.koch_follower", "KochFollower", DYNAMIXEL),
    "lekiwi": RobotClass("lerobot.robots.lekiwi", "LeKiwi", FEETECH),
    "so100_follower": RobotClass("lerobot.robots.so_follower", "SO100Follower", FEETECH),
    "so101_follower": RobotClass("lerobot.robots.so_follower", "SO101Follower", FEETECH),
}
"""LeRobot's name of the robot → class."""
